# pyright: reportMissingImports=false
"""A plant in Pinocchio: rigid contact with Coulomb's law (the extra `pinocchio`).

Dynamics and contact solver are Pinocchio's, the time stepping is Moreau's: the velocities at the
end of a step follow from impulses that keep the soles' points out of the floor. The floor is
rigid, and friction is Coulomb's cone itself, not a convex relaxation of it. Legs that touch are
reported and pass through each other.
"""

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float

from hector_jax.core.inputs import InputError
from hector_jax.robot.mjcf import TIME_STEP
from hector_jax.robot.model import Robot
from hector_jax.sim import bodies
from hector_jax.sim.bodies import Body
from hector_jax.sim.loop import Job
from hector_jax.sim.plant import LEGS, OTHER, Plant, PointContacts
from hector_jax.sim.sensing import Ground
from hector_jax.sim.world import STOP_TIME, World, build_world, standing_qpos

if not hasattr(pin, "ADMMConstraintSolver"):  # PyPI has a `pinocchio` of other people
    raise InputError(
        f"Pinocchio (pip install 'pin>=4.1') is expected, {pin.__file__} is another one"
    )

_NEAR = 1e-3  # [m] height above the floor below which a point may touch within the step
_BEND = 0.1  # share of the backlash by which the largest torque bends the gear's teeth
_TOLERANCE = 1e-9  # [m/s], of the contact solver
# shares of the mean diagonal that are added, as impulses at four points of a flat sole are not
# unique; the larger shares are tried if the solver does not end with a smaller one
_REGULARISATION = 1e-6, 1e-3, 1e-2
_MAX_RESIDUAL = 1e-4  # [m/s], of the solver, above which a step counts as failed
_SHAPES = {
    "plane": lambda size: coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0),
    "sphere": lambda size: coal.Sphere(size[0]),
    "capsule": lambda size: coal.Capsule(size[0], 2.0 * size[1]),
    "box": lambda size: coal.Box(*(2.0 * size)),
}


class PinocchioPlant(Plant):
    """A `Plant` in Pinocchio."""

    def __init__(self, job: Job, body: Robot, first: int, end: int) -> None:
        """Build as a `BuildPlant` does."""
        world = build_world(job.imperfections, body.description)
        robot = bodies.bodies(world)
        self.model, joint_of = _model(robot, world)
        hinges = [hinge for part in robot for hinge in part.hinges]
        index = {h.dof: self.model.idx_vs[self.model.getJointId(h.name)] for h in hinges}
        self._motors = np.array([index[dof] for dof in world.joint_dof])
        self._slack = np.array([index[world.model.jnt_dofadr[j]] for j in world.slack], int)
        self.order = np.array([index[hinge.dof] for hinge in hinges])
        self._friction, self._stiction = bodies.dry_friction(hinges)
        armature, self._damping = np.zeros((2, self.model.nv))
        armature[self.order] = [hinge.armature for hinge in hinges]
        self._damping[self.order] = [hinge.damping for hinge in hinges]
        self.model.armature = armature
        self.data, self.failed = self.model.createData(), False
        width = float(job.imperfections.backlash)
        self._width, self._teeth = width, np.asarray(body.torque_limit) / (_BEND * (width or 1.0))
        self._com, self._trunk = world.model.body_ipos[world.trunk], joint_of[world.trunk]
        self._soles = _Soles(world, self.model, joint_of)
        self._others = _Others(world, self.model, joint_of)
        self._contacts = PointContacts(len(body.foot_point))
        self.stand(standing_qpos(world, body.standing_joints, float(body.trunk_height)))

    def stand(self, qpos: Float[np.ndarray, " nq"]) -> None:
        """Take up the coordinates of a MuJoCo model of this world, at rest."""
        self.q, self.v = np.zeros(self.model.nq), np.zeros(self.model.nv)
        self.q[:3], self.q[3:7] = qpos[:3], qpos[[4, 5, 6, 3]]
        self.q[self.order + 1] = qpos[7:]  # the trunk's quaternion has one more

    @property
    def broken(self) -> bool:
        """Return whether the contact solver failed, or the state is not finite."""
        return self.failed or not np.isfinite(self.v).all()

    def step(self, torque: Float[np.ndarray, " joints"], push: Float[np.ndarray, "3"]) -> None:
        """See `Plant`."""
        if self.broken:
            self._contacts.end_step()
            return
        model, data, v = self.model, self.data, self.v
        pin.computeAllTerms(model, data, self.q, v)  # mass matrix, nonlinear effects, Jacobians
        A = np.triu(data.M) + np.triu(data.M, 1).T  # the lower half is not filled in
        force = -data.nle - self._damping * v
        force[self.order] -= self._friction * np.tanh(v[self.order] / self._stiction)
        force[self._motors] += torque
        if push.any():
            R = data.oMi[self._trunk].rotation
            force[:3] += R.T @ push
            force[3:6] += np.cross(self._com, R.T @ push)
        stiff = self._damping.copy()
        if len(self._slack):
            self._add_stops(force, stiff)
        A[np.diag_indices_from(A)] += TIME_STEP * stiff
        self.v = v + np.linalg.solve(A, TIME_STEP * force)
        self._add_impulses(A)
        self.q = pin.integrate(model, self.q, TIME_STEP * self.v)
        self._others.note(model, data, self._contacts)
        self._contacts.end_step()

    def _add_stops(self, force: Float[np.ndarray, " nv"], stiff: Float[np.ndarray, " nv"]) -> None:
        """Add teeth at the ends of the backlash, springs and dampers linear over the step."""
        gap = self.q[self._slack + 1]
        over = gap - np.clip(gap, -self._width, self._width)
        slope = (over != 0.0) * self._teeth * STOP_TIME  # damper and spring over a step together
        force[self._slack] -= self._teeth * over + slope * self.v[self._slack]
        stiff[self._slack] += slope

    def _add_impulses(self, A: Float[np.ndarray, "nv nv"]) -> None:
        """Add impulses at the points that would sink in."""
        feet, points, J = self._soles.near(self.model, self.data)
        if not len(points):
            return
        inverse = np.linalg.solve(A, J.T)
        free = (J @ self.v).reshape(-1, 3)
        free[:, 2] += points[:, 2] / TIME_STEP  # at most down to the floor, and out of it at once
        impulse, self.failed = self._soles.solve(J @ inverse, free.ravel())
        self.v = self.v + inverse @ impulse
        forces = impulse.reshape(-1, 3) / TIME_STEP
        for foot, force, point in zip(feet, forces, points, strict=True):
            if force.any():
                self._contacts.note(foot, force, point)

    def read(self, row: Float[np.ndarray, " reading"]) -> None:
        """See `Plant`."""
        joints, R = len(self._motors), pin.Quaternion(self.q[3:7]).toRotationMatrix()
        row[:3], row[3:7] = self.q[:3], self.q[[6, 3, 4, 5]]
        row[7:10], row[10:13] = R @ self.v[:3], self.v[3:6]
        row[13 : 13 + joints] = self.q[self._motors + 1]
        row[13 + joints : 13 + 2 * joints] = self.v[self._motors]
        row[13 + 2 * joints :] = self.q[self._slack + 1] if len(self._slack) else 0.0

    def ground(self) -> Ground:
        """See `Plant`."""
        return self._contacts.ground()


def _model(robot: list[Body], world: World) -> tuple[pin.Model, dict[int, int]]:
    """Return Pinocchio's model without armature, and its joint for each body of MuJoCo's."""
    model, joint_of = pin.Model(), {0: 0}
    model.gravity.linear = np.array(world.model.opt.gravity)
    for body in robot:
        joint, place = joint_of[body.parent], pin.SE3(body.rotation, body.position)
        if not body.hinges:
            free = pin.JointModelFreeFlyer()
            joint = model.addJoint(joint, free, pin.SE3.Identity(), body.name)
        for hinge in body.hinges:
            turn = pin.JointModelRevoluteUnaligned(np.array(hinge.axis))
            joint, place = model.addJoint(joint, turn, place, hinge.name), pin.SE3.Identity()
        inertia = pin.Inertia(body.mass, np.array(body.com), body.inertia)
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        joint_of[body.id] = joint
    return model, joint_of


class _Soles:
    """The spheres of the soles, and impulses at those near the floor."""

    def __init__(self, world: World, model: pin.Model, joint_of: dict[int, int]) -> None:
        spheres = bodies.soles(world)
        self._joints = [joint_of[sphere.body] for sphere in spheres]
        self._centres = np.array([sphere.position for sphere in spheres])
        self._radii = np.array([sphere.size[0] for sphere in spheres])
        self._foot = world.foot_of_geom[[sphere.id for sphere in spheres]]
        self._solver, self._settings = pin.ADMMConstraintSolver(), pin.ADMMSolverSettings()
        self._settings.absolute_feasibility_tol = _TOLERANCE
        self._settings.absolute_complementarity_tol = _TOLERANCE
        self._settings.admm_update_rule = pin.ADMMUpdateRule.SPECTRAL  # the default cycles at times
        friction = float(world.model.geom_friction[world.floor, 0])
        self._cones = [_cones(model, count, friction) for count in range(len(spheres) + 1)]

    def near(
        self, model: pin.Model, data: pin.Data
    ) -> tuple[list[int], Float[np.ndarray, "n 3"], Float[np.ndarray, "m nv"]]:
        """Return feet and positions [m] of the points near the floor, and their world Jacobian."""
        places = [data.oMi[joint] for joint in self._joints]
        centres = np.array([place.act(c) for place, c in zip(places, self._centres, strict=True)])
        points = centres - np.outer(self._radii, [0.0, 0.0, 1.0])
        rows = np.flatnonzero(points[:, 2] < _NEAR)
        J = np.zeros((len(rows), 3, model.nv))
        for row, i in enumerate(rows):
            J_joint = pin.getJointJacobian(model, data, self._joints[i], pin.LOCAL_WORLD_ALIGNED)
            J[row] = J_joint[:3] - pin.skew(points[i] - places[i].translation) @ J_joint[3:]
        return self._foot[rows].tolist(), points[rows], J.reshape(-1, model.nv)

    def solve(
        self, G: Float[np.ndarray, "m m"], free: Float[np.ndarray, " m"]
    ) -> tuple[Float[np.ndarray, " m"], bool]:
        """Solve Signorini's and Coulomb's laws for impulses [N s]; return whether that failed too.

        Args:
            G: Delassus matrix, velocities of the points per unit impulse at them [1/kg].
            free: velocities without impulses [m/s].
        """
        (models, datas), mean = self._cones[len(free) // 3], np.trace(G) / len(G)
        result = pin.ADMMSolverResult()
        for share in _REGULARISATION:
            delassus = pin.DelassusOperatorDense(G + share * mean * np.eye(len(G)))
            result.reset()
            if self._solver.solve(delassus, free, models, datas, self._settings, result):
                break
        residual = max(result.primal_feasibility, result.dual_feasibility, result.complementarity)
        return np.array(result.retrieveConstraintImpulses()), not residual < _MAX_RESIDUAL


def _cones(
    model: pin.Model, count: int, friction: float
) -> tuple[pin.StdVec_ConstraintModel, pin.StdVec_ConstraintData]:
    """Return friction cones about the world's z axis, for `count` points."""
    models, datas = pin.StdVec_ConstraintModel(), pin.StdVec_ConstraintData()
    for _ in range(count):
        contact = pin.PointContactConstraintModel(model, 1)
        contact.setFriction(friction)
        models.append(pin.ConstraintModel(contact))
        datas.append(pin.ConstraintModel(contact).createData())
    return models, datas


class _Others:
    """Contacts other than those of soles and floor: detected, without forces."""

    def __init__(self, world: World, model: pin.Model, joint_of: dict[int, int]) -> None:
        self._geometry, index = pin.GeometryModel(), {}
        soles = {sole.id for sole in bodies.soles(world)}
        for shape in bodies.shapes(world):
            place, solid = pin.SE3(shape.rotation, shape.position), _SHAPES[shape.kind](shape.size)
            geometry = pin.GeometryObject(str(shape.id), joint_of[shape.body], place, solid)
            index[shape.id] = self._geometry.addGeometryObject(geometry)
        self._kinds = []
        for pair in sorted(bodies.touching_pairs(world)):
            if not (world.floor in pair and soles & set(pair)):
                self._geometry.addCollisionPair(pin.CollisionPair(*(index[i] for i in pair)))
                self._kinds.append(OTHER if world.floor in pair else LEGS)
        self._data = self._geometry.createData()

    def note(self, model: pin.Model, data: pin.Data, contacts: PointContacts) -> None:
        """Note the collisions at the poses of `data`."""
        pin.updateGeometryPlacements(model, data, self._geometry, self._data)
        if pin.computeCollisions(self._geometry, self._data, True):
            pin.computeCollisions(self._geometry, self._data, False)
            for kind, result in zip(self._kinds, self._data.collisionResults, strict=True):
                if result.isCollision():
                    contacts.note(kind, np.zeros(3), np.zeros(3))
