"""The study of `trial effort`: every setting of the compensator, and what each task costs the wearer under it.

The wearer's passive arm is `WEARER_EXCESS` heavier than configured. Motors may give their peak torque: an arm of 75 kg
of wearer is beyond what they are rated for. The terms know ninety per cent of the joints' friction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from exo_gravity.core.compensation.settings import Settings
from exo_gravity.core.compensation.terms.friction_inertia import Friction, Inertia
from exo_gravity.core.compensation.terms.settings import TermSettings
from exo_gravity.core.compensation.terms.springs import DELAY, Coupling, Damping, SoftLimits, Spring
from exo_gravity.core.effort import Effort
from exo_gravity.core.model.kinematics import LinkInertia
from exo_gravity.core.motors.joint_motor import JointMotor
from exo_gravity.sim.device import SimulatedDevice
from exo_gravity.sim.effort import Sweep, Task, measure

WEARER_EXCESS = 1.03
IDENTIFIED = 0.9  # share of the friction that `calibrate` found
MIDDLE = (0.1, 0.6, 0.6, 0.7)  # rad
RATE = 250.0  # Hz
SOFT = 0.9  # share of the stiffness and viscosity that this arm can bear
POSES = Task(
    "poses",
    (
        (0.0, 0.3, 0.2, 0.3), (0.0, 0.3, 0.8, 1.2), (0.0, 0.3, 1.5, 0.4), (-0.6, 0.5, 1.1, 1.6), (0.6, 0.5, 1.1, 0.6),
        (0.0, 0.9, -0.3, 0.5), (0.0, 0.9, 0.5, 1.0), (-0.8, 0.9, 0.9, 0.4), (0.8, 0.9, 0.3, 1.8), (0.0, 1.4, 0.0, 0.3),
        (0.4, 1.4, 0.5, 1.4), (-0.4, 1.8, 0.3, 0.8), (0.0, 0.6, 2.0, 0.5),
    ),
    move=1.5,
    hold=1.0,
)  # fmt: skip
REACH = Task("reach", ((0.0, 0.4, 0.3, 0.5), (0.3, 0.7, 0.7, 0.9)) * 4, move=1.0, hold=0.5)
SWEEPS = tuple(Sweep(f"sweep {n + 1}", MIDDLE, n, length=12.0) for n in range(4))
TASKS: tuple[Task | Sweep, ...] = (POSES, REACH, *SWEEPS)


def effort_settings(base: Settings, coulomb: Sequence[float], viscous: Sequence[float]) -> dict[str, Settings | None]:
    """Return the settings that are compared, by name; None: the motors are on without torque.

    base: of the arm and its wearer. coulomb Nm, viscous Nm s/rad: the friction that the terms know, (4,) each.
    """
    known = Friction(coulomb=coulomb, viscous=viscous)
    links = base.robot_by_mass or base.robot
    least = LinkInertia.of(links).least()
    soft = [min(20.0, SOFT * inertia / (4.0 * DELAY**2)) for inertia in least]  # Nm/rad
    terms = {
        "friction": TermSettings(friction=replace(known, share=0.4)),
        "inertia": TermSettings(friction=known, inertia=Inertia(0.7)),
        "friction and inertia": TermSettings(friction=replace(known, share=0.4), inertia=Inertia(0.7)),
        "damping": TermSettings(damping=Damping([SOFT * inertia / (2.0 * DELAY) for inertia in least])),
        "spring": TermSettings(spring=Spring(soft, MIDDLE)),
        "coupling": TermSettings(coupling=Coupling((0.0, 0.0, -0.4 * min(soft), 0.5 * min(soft)))),
        "limits": TermSettings(limits=SoftLimits((-0.5, 1.5, 0.3, 1.6, 0.0, 1.6, 0.2, 2.5), soft)),
    }
    zero = replace(base, mode="zero_g", support=1.0)
    return {
        "nothing": None,
        "One-G": replace(base, mode="one_g"),
        **{f"Zero-G {share} %": replace(zero, support=share / 100.0) for share in (0, 25, 50, 75, 100)},
        **{f"+ {name}": replace(zero, terms=chosen) for name, chosen in terms.items()},
    }


def study(
    device: Callable[[], SimulatedDevice],
    motors: Sequence[JointMotor],
    settings: dict[str, Settings | None],
    tasks: Sequence[Task | Sweep] = TASKS,
) -> Iterator[tuple[str, str, Effort]]:
    """Yield setting, task and effort, one after the other; device(): a new device for each."""
    for name, chosen in settings.items():
        for task in tasks:
            yield name, task.name, measure(device(), motors, chosen, task, RATE)
