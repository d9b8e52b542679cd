# pyright: reportMissingImports=false, reportArgumentType=false, reportCallIssue=false
"""A plant in Drake: compliant contact at points, solved as a convex problem (the extra `drake`).

It is built from a world's bodies, not by Drake's own reader of MJCF, which reads two joints on one
body wrong and leaves out contact bits and dry friction. With backlash, a body of a milligram lies
between the motor's and the gear's hinge. Dry friction is a torque added here: Drake has none.
"""

import logging
from collections.abc import Mapping
from itertools import combinations

import numpy as np
from jaxtyping import Float
from pydrake import geometry
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import plant as multibody
from pydrake.multibody import tree
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.robot.poses import rotation_of
from hector_jax.sim import bodies
from hector_jax.sim.bodies import Body
from hector_jax.sim.loop import Job
from hector_jax.sim.plant import LEGS, OTHER, Plant, PointContacts
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import World, build_world, standing_qpos

_SMALL_MASS = 1e-6  # [kg] of the body between a motor's hinge and a gear's
_SHAPES = {
    "plane": lambda size: geometry.HalfSpace(),
    "sphere": lambda size: geometry.Sphere(size[0]),
    "capsule": lambda size: geometry.Capsule(size[0], 2.0 * size[1]),
    "box": lambda size: geometry.Box(*(2.0 * size)),
}
# Drake warns that deformable bodies, of which there are none, miss half spaces
logging.getLogger("drake").addFilter(lambda record: "deformable" not in record.getMessage())


class DrakePlant(Plant):
    """A `Plant` in Drake."""

    def __init__(self, job: Job, body: Robot, first: int, end: int) -> None:
        """Build as a `BuildPlant` does."""
        world = build_world(job.imperfections, body.description)
        builder = DiagramBuilder()
        plant, scene = multibody.AddMultibodyPlantSceneGraph(builder, TIME_STEP)
        plant.set_discrete_contact_approximation(multibody.DiscreteContactApproximation.kLagged)
        plant.mutable_gravity_field().set_gravity_vector(world.model.opt.gravity)
        links, joints = _add_bodies(plant, bodies.bodies(world))
        _add_shapes(plant, scene, links, world)
        plant.Finalize()
        self._simulator = Simulator(builder.Build())
        self.context = plant.GetMyMutableContextFromRoot(self._simulator.get_mutable_context())
        self.plant, self._trunk = plant, links[world.trunk]
        self._com = np.array(world.model.body_ipos[world.trunk])
        soles, feet = bodies.soles(world), world.foot_of_geom
        self._foot_of_body = {int(links[s.body].index()): int(feet[s.id]) for s in soles}
        self._contacts, self._time, self._failed = PointContacts(len(body.foot_point)), 0, False
        self.joints = joints
        self._index(world)
        self.stand(standing_qpos(world, body.standing_joints, float(body.trunk_height)))

    def _index(self, world: World) -> None:
        """Look up Drake's indices of base, motors, backlash and hinges."""
        joints, nq, nv = self.joints, self.plant.num_positions(), self.plant.num_velocities()
        motors = [joints[dof] for dof in world.joint_dof]
        slack = [joints[world.model.jnt_dofadr[j]].position_start() for j in world.slack]
        base = self._trunk.floating_positions_start()
        self._base_rates = self._trunk.floating_velocities_start_in_v()
        self._motors = np.array([joint.velocity_start() for joint in motors])
        self._reading_index = np.concatenate(
            [
                base + np.r_[4:7, 0:4],
                nq + self._base_rates + np.r_[3:6, 0:3],
                [joint.position_start() for joint in motors],
                nq + self._motors,
                slack or np.full(len(motors), nq + nv),
            ]
        ).astype(int)
        hinges = [hinge for body in bodies.bodies(world) for hinge in body.hinges]
        self._hinges = np.array([joints[hinge.dof].velocity_start() for hinge in hinges])
        self._friction, self._stiction = bodies.dry_friction(hinges)
        self._state, self._force = np.zeros(nq + nv + 1), np.zeros(nv)
        port = self.plant.get_applied_generalized_force_input_port()
        self._input = port.FixValue(self.context, self._force).GetMutableData()
        self._rates = nq

    def stand(self, qpos: Float[np.ndarray, " nq"]) -> None:
        """Take up the coordinates of a MuJoCo model of this world, at rest."""
        pose = RigidTransform(RotationMatrix(rotation_of(qpos[3:7])), qpos[:3])
        self.plant.SetFreeBodyPose(self.context, self._trunk, pose)
        for dof, joint in self.joints.items():
            joint.set_angle(self.context, qpos[dof + 1])  # the trunk's quaternion has one more
        self._simulator.Initialize()
        self._read_state()

    def _read_state(self) -> None:
        self._state[:-1] = self.plant.GetPositionsAndVelocities(self.context)

    @property
    def broken(self) -> bool:
        """Return whether Drake's solver failed."""
        return self._failed

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """See `Plant`."""
        if self._failed:
            self._contacts.end_step()
            return
        rates, force = self._state[self._rates : -1], self._force
        force[:] = 0.0
        force[self._hinges] = -self._friction * np.tanh(rates[self._hinges] / self._stiction)
        force[self._motors] += torque
        if push.any():
            lever = rotation_of(self._state[self._reading_index[3:7]]) @ self._com
            force[self._base_rates : self._base_rates + 6] = *np.cross(lever, push), *push
        self._input.set_value(force)
        self._time += 1
        try:
            # a multiple of the step: a sum of steps drifts, and a step is made twice or not at all
            self._simulator.AdvanceTo(self._time * TIME_STEP)
        except RuntimeError:
            self._failed = True
        else:
            self._read_state()
            self._note_contacts()
        self._contacts.end_step()

    def _note_contacts(self) -> None:
        contacts = self.plant.get_contact_results_output_port().Eval(self.context)
        for i in range(contacts.num_point_pair_contacts()):
            info = contacts.point_pair_contact_info(i)
            body_a, body_b = int(info.bodyA_index()), int(info.bodyB_index())
            force = info.contact_force() if body_b else -info.contact_force()  # 0 is the world
            foot = LEGS if body_a and body_b else self._foot_of_body.get(body_a or body_b, OTHER)
            self._contacts.note(foot, force, info.contact_point())

    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """See `Plant`."""
        self._state.take(self._reading_index, out=row)
        row[3:7] /= np.linalg.norm(row[3:7])  # Drake lets the quaternion's norm drift
        row[10:13] = row[10:13] @ rotation_of(row[3:7])  # into the trunk's frame

    def ground(self) -> Ground:
        """See `Plant`."""
        return self._contacts.ground()


def _add_bodies(
    plant: multibody.MultibodyPlant, robot: list[Body]
) -> tuple[dict[int, tree.RigidBody], dict[int, tree.RevoluteJoint]]:
    """Add links and joints; return links by MuJoCo's body and joints by its degree of freedom."""
    links, joints = {0: plant.world_body()}, {}
    for body in robot:
        parent = links[body.parent]
        place = RigidTransform(RotationMatrix(body.rotation), body.position)
        links[body.id] = link = plant.AddRigidBody(body.name, _inertia(body))
        for hinge in body.hinges:
            child = link
            if hinge is not body.hinges[-1]:
                ball = tree.UnitInertia.SolidSphere(0.01)
                small = tree.SpatialInertia(_SMALL_MASS, np.zeros(3), ball)
                child = plant.AddRigidBody(f"{hinge.name} side", small)
            anchor = tree.FixedOffsetFrame(f"{hinge.name} anchor", parent.body_frame(), place)
            at, of = plant.AddFrame(anchor), child.body_frame()
            joint = tree.RevoluteJoint(hinge.name, at, of, hinge.axis, hinge.damping)
            joints[hinge.dof] = joint = plant.AddJoint(joint)
            joint.set_position_limits([hinge.limits[0]], [hinge.limits[1]])
            plant.AddJointActuator(hinge.name, joint).set_default_rotor_inertia(hinge.armature)
            parent, place = child, RigidTransform()
    return links, joints


def _inertia(body: Body) -> tree.SpatialInertia:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = body.inertia
    central = tree.RotationalInertia(xx, yy, zz, xy, xz, yz)
    return tree.SpatialInertia.MakeFromCentralInertia(body.mass, body.com, central)


def _add_shapes(
    plant: multibody.MultibodyPlant,
    scene: geometry.SceneGraph,
    links: Mapping[int, tree.RigidBody],
    world: World,
) -> None:
    """Add the geoms that may touch something, and a filter of the pairs that may not."""
    rough, ids = {world.floor, *(sole.id for sole in bodies.soles(world))}, {}
    stiffness, damping = bodies.contact_spring(world, len(rough) - 1)
    for shape in bodies.shapes(world):
        friction = world.model.geom_friction[world.floor, 0] * (shape.id in rough)
        properties = geometry.ProximityProperties()
        cone = multibody.CoulombFriction(friction, friction)
        # two springs in a row have half the stiffness of one
        geometry.AddContactMaterial(damping, 2.0 * stiffness, cone, properties)
        place = RigidTransform(RotationMatrix(shape.rotation), shape.position)
        ids[shape.id] = plant.RegisterCollisionGeometry(
            links[shape.body], place, _SHAPES[shape.kind](shape.size), str(shape.id), properties
        )
    touching, excluded = bodies.touching_pairs(world), geometry.CollisionFilterDeclaration()
    for pair in combinations(sorted(ids), 2):
        if pair not in touching:
            excluded.ExcludeBetween(*(geometry.GeometrySet(ids[geom]) for geom in pair))
    scene.collision_filter_manager().Apply(excluded)
