"""Drake (discrete MultibodyPlant with hydroelastic contact) on the CPU, in double precision.

What differs from Drake's defaults, and why:

- Gravity is off for the object, whose weight is part of the force that the pool gives. It is off for the robot if that is compensated.
- Friction of a pair is the *harmonic mean* of its two coefficients; the object's own is fixed, and the others are solved for.
- The drives are Drake's own PD controllers, which its solver treats implicitly, effort limits included. Armature is the rotor's inertia.
- Drake ends the process, or raises, where a number is not finite. Such a state never reaches it: see :attr:`DrakeWorld._lost`.

Drake's poses and velocities are those of the interface already: of the body's origin, in the world frame.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from importlib.metadata import version
from itertools import product
from typing import get_args

import numpy as np

from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    Inertia,
    MovingJoints,
    mechanism,
    nearer,
    object_inertia,
    principal,
)
from xreset.errors import XResetError
from xreset.physics import Capability, KnownDifference, unavailable
from xreset.spec import SceneSpec

try:
    from pydrake.common.value import Value
    from pydrake.geometry import AddContactMaterial, ProximityProperties, RoleAssign
    from pydrake.multibody.math import SpatialForce
    from pydrake.multibody.plant import CoulombFriction, ExternallyAppliedSpatialForce
    from pydrake.systems.analysis import Simulator
except ImportError as error:
    raise unavailable("pydrake", "drake", error) from error

from xreset_drake.model import (
    OBJECT_FRICTION,
    DrakeSettings,
    build_model,
    friction_of_other,
    spatial_inertia,
)

_DEFAULTS = DrakeSettings()


class DrakeWorld(World):
    """One world of Drake: a diagram and a context of its own."""

    def __init__(
        self, scene: SceneSpec, object_index: int, *, settings: DrakeSettings = _DEFAULTS
    ) -> None:
        """See :class:`World`."""
        robot = mechanism(scene.robot)
        obj = scene.objects[object_index]
        self._inertia = object_inertia(obj)
        self._at = at = build_model(scene, robot, obj, self._inertia, settings)
        self._internal_steps = settings.internal_steps
        self._dt = scene.timestep / settings.internal_steps
        self._joints = MovingJoints(scene.robot, robot.joint_names)

        self._simulator = Simulator(at.diagram)
        self._root = self._simulator.get_mutable_context()
        self._context = at.plant.GetMyMutableContextFromRoot(self._root)
        self._geometry = at.scene_graph.GetMyMutableContextFromRoot(self._root)
        self._sizes = at.plant.num_positions(), at.plant.num_velocities()
        self._object_q = at.object.floating_positions_start()
        self._object_v = at.object.floating_velocities_start_in_v()

        self._lost: np.ndarray | None = None
        """Positions and velocities that are not finite, and that Drake therefore has not been given."""
        self._target = scene.robot.home
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._steps = 0
        self._friction: dict[str, float] = {}
        self._set_friction({"object": OBJECT_FRICTION})
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """See :meth:`World.set_state`. Drake's state is all that its solver remembers: nothing else has to be forgotten."""
        at = self._at
        i = self._object_q
        j = self._object_v
        q, v = (np.zeros(size) for size in self._sizes)
        q[at.position], v[at.velocity] = self._joints.spread(state["joint_pos"], state["joint_vel"])
        self._quat = state["object_quat"] / np.linalg.norm(state["object_quat"])
        q[i : i + 4] = self._quat
        q[i + 4 : i + 7] = state["object_pos"]
        v[j : j + 3] = state["object_angvel"]
        v[j + 3 : j + 6] = state["object_linvel"]
        values = np.concatenate((q, v))
        self._lost = None if np.isfinite(values).all() else values
        if self._lost is None:
            at.plant.SetPositionsAndVelocities(self._context, values)
        self.set_joint_targets(state["joint_target"])
        self._steps = 0
        self._root.SetTime(0.0)
        self._simulator.Initialize()

    def get_state(self) -> dict[str, np.ndarray]:
        """See :meth:`World.get_state`."""
        at = self._at
        i = self._object_q
        j = self._object_v
        values = (
            at.plant.GetPositionsAndVelocities(self._context) if self._lost is None else self._lost
        )
        q, v = np.split(values, self._sizes[:1])
        self._quat = nearer(q[i : i + 4], self._quat)
        return {
            "joint_pos": q[at.position[self._joints.driven]],
            "joint_vel": v[at.velocity[self._joints.driven]],
            "joint_target": self._target,
            "object_pos": q[i + 4 : i + 7],
            "object_quat": self._quat,
            "object_linvel": v[j + 3 : j + 6],
            "object_angvel": v[j : j + 3],
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        """See :meth:`World.set_joint_targets`."""
        self._target = np.array(targets)
        desired = np.zeros(2 * len(targets))  # positions, then velocities
        desired[self._at.actuator] = targets
        self._at.plant.get_desired_state_input_port(self._at.robot).FixValue(self._context, desired)

    def step(self, n: int) -> None:
        """See :meth:`World.step`."""
        if self._lost is not None:
            return
        at = self._at
        load = ExternallyAppliedSpatialForce()
        load.body_index = at.object.index()
        load.p_BoBq_B = self._inertia.com
        load.F_Bq_W = SpatialForce(self.torque, self.force)
        at.plant.get_applied_spatial_force_input_port().FixValue(
            self._context, Value[list[ExternallyAppliedSpatialForce]]([load])
        )
        steps = n * self._internal_steps
        at_once = 1 if self._joints.has_dry_friction else steps
        for _ in range(steps // at_once):
            if self._joints.has_dry_friction:
                self._brake()
            self._steps += at_once
            try:
                self._simulator.AdvanceTo(self._steps * self._dt)
            except RuntimeError as error:  # it says so that numbers grow beyond all bounds
                warnings.warn(
                    f"Drake gives up on a world, which counts as not finite from now on: {error}",
                    stacklevel=2,
                )
                self._lost = np.full(sum(self._sizes), np.nan)
                return

    def _brake(self) -> None:
        """Set the torques of dry friction for one step, which Drake lacks.

        They are what would bring the joints to rest within the step, as far as the friction loss allows; contacts are not foreseen.
        """
        plant = self._at.plant
        joints = self._joints
        stiffness, damping, effort = joints.nominal
        row = self._at.velocity[joints.driven]
        position = plant.GetPositions(self._context)[self._at.position[joints.driven]]
        velocity = plant.GetVelocities(self._context)[row]
        drive = stiffness * (self._target - position) - damping * velocity
        felt = 1.0 / np.diag(np.linalg.inv(plant.CalcMassMatrix(self._context)))[row]
        stopping = -felt * velocity / self._dt - np.clip(drive, -effort, effort)
        torque = np.zeros(plant.num_velocities())
        torque[row] = np.clip(stopping, -joints.friction_loss, joints.friction_loss)
        plant.get_applied_generalized_force_input_port().FixValue(self._context, torque)

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.links`."""
        frames = self._at.links
        if self._lost is not None:
            return tuple(np.full((len(frames), size), np.nan) for size in (3, 4, 3, 3))
        poses = [frame.CalcPoseInWorld(self._context) for frame in frames]
        motions = [frame.CalcSpatialVelocityInWorld(self._context) for frame in frames]
        return (
            np.array([pose.translation() for pose in poses]),
            np.array([pose.rotation().ToQuaternion().wxyz() for pose in poses]),
            np.array([motion.translational() for motion in motions]),
            np.array([motion.rotational() for motion in motions]),
        )

    def contacts(self) -> list[tuple[int, np.ndarray]]:
        """See :meth:`World.contacts`: of the last internal step, which is what Drake's output ports report."""
        if self._lost is not None:
            return []
        found = []
        results = self._at.plant.get_contact_results_output_port().Eval(self._context)
        for contact in map(
            results.hydroelastic_contact_info, range(results.num_hydroelastic_contacts())
        ):
            patch = contact.contact_surface()
            # on the first of the two geometries
            force = contact.F_Ac_W().translational()
            first = self._at.surfaces[patch.id_M()]
            second = self._at.surfaces[patch.id_N()]
            if second.role == "object":
                first, second = second, first
                force = -force
            if first.role != "object" or not force.any():
                continue
            owner = OTHER_LINK if second.tip is None else second.tip
            found.append((TABLE if second.role == "table" else owner, force))
        return found

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`."""
        found = []
        for body in (*self._at.moving, self._at.object):
            about_origin = body.CalcSpatialInertiaInBodyFrame(self._context)
            com = about_origin.get_com()
            central = about_origin.Shift(com).CalcRotationalInertia().CopyToFullMatrix3()
            found.append(
                principal(
                    about_origin.get_mass(),
                    com,
                    central,
                    XResetError,
                    f"Drake's body {body.name()!r}",
                )
            )
        return found

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`."""
        self._inertia = inertia
        self._at.object.SetSpatialInertiaInBodyFrame(self._context, spatial_inertia(inertia))

    def set_friction(self, friction: np.ndarray) -> None:
        """See :meth:`World.set_friction`."""
        self._set_friction(
            {
                role: friction_of_other(float(mu))
                for role, mu in zip(("tip", "link", "table"), friction, strict=True)
            }
        )

    def _set_friction(self, coefficients: Mapping[str, float]) -> None:
        """Give the geometries of some roles a coefficient of their own. Drake rebuilds what has changed, so only that is touched."""
        changed: Collection[str] = {
            role for role, mu in coefficients.items() if self._friction.get(role) != mu
        }
        self._friction |= coefficients
        at = self._at
        for geometry, surface in at.surfaces.items():
            if surface.role in changed:
                properties = ProximityProperties(at.properties[geometry])
                mu = self._friction[surface.role]
                AddContactMaterial(properties, friction=CoulombFriction(mu, mu))
                at.scene_graph.AssignRole(
                    self._geometry,
                    at.plant.get_source_id(),
                    geometry,
                    properties,
                    RoleAssign.kReplace,
                )


_DAMPED = "drives are integrated by implicit Euler steps, which damp: the difference shrinks with the step"
_FIRST_ORDER = "steps are of first order: the error of a spin is in proportion to the step"
_PAIRS = "coefficients of the robot and of the table are solved for their pairs with the object, and Drake takes the harmonic mean of the two"
_ROCKING = "a brick that is laid on its edge rocks for a second, because contacts dissipate little; then the force is right to 0.1 %"
_PITCHING = "friction tilts an object on the compliant table and lags behind its normal force, so that a fast one chatters"

_KNOWN_DIFFERENCES = (
    *(
        KnownDifference(
            check="drive_equation",
            measure=f"step of {step} m, stiffer and weaker",
            bound=0.05,
            reason=_DAMPED,
        )
        for step in ("+0.08", "-0.08")
    ),
    KnownDifference(check="long_spin", measure="angular momentum", bound=0.2, reason=_FIRST_ORDER),
    KnownDifference(check="long_spin", measure="centre of mass", bound=2e-3, reason=_FIRST_ORDER),
    KnownDifference(check="robot_friction", measure="on the table", bound=0.8, reason=_PAIRS),
    KnownDifference(check="robot_friction", measure="on the shelf", bound=0.8, reason=_PAIRS),
    KnownDifference(
        check="resting_on_a_side", measure="vertical force", bound=0.15, reason=_ROCKING
    ),
    KnownDifference(
        check="resting_on_a_side", measure="horizontal force", bound=0.3, reason=_ROCKING
    ),
    KnownDifference(
        check="rest_and_bounce",
        measure="bounce",
        bound=0.004,
        reason="more dissipation would stop sliding objects too early",
    ),
    *(
        KnownDifference(
            check="sliding_distance",
            measure=f"mu {mu}, {degrees} degrees",
            bound=bound,
            reason=_PITCHING,
        )
        for (mu, bound), degrees in product(((0.5, 0.15), (0.8, 0.3), (1.2, 0.8)), (0, 45))
    ),
    KnownDifference(
        check="slope", measure="acceleration, mu 1.2, 0 degrees", bound=1.5, reason=_PITCHING
    ),
    KnownDifference(
        check="torsional_friction",
        measure="spin lost",
        bound=0.5,
        reason="torsional friction comes from the size of the contact patch, and not from the scene's figure",
    ),
)


class DrakeBackend(PoolBackend):
    """N worlds of Drake; the keyword ``settings`` takes :class:`DrakeSettings`."""

    name = "drake"
    capabilities = frozenset(get_args(Capability)) - {"drives", "torsional_friction"}
    known_differences = _KNOWN_DIFFERENCES
    world_class = DrakeWorld

    @classmethod
    def engine_version(cls) -> str:
        """See :meth:`Backend.engine_version`."""
        return version("drake")
