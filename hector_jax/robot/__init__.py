"""The robot: its model file, kinematics and single rigid body."""
