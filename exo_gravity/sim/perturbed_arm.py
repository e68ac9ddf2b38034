"""Simulated arms that differ from the controller's model, for the evidence on the terms `friction` and `inertia`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from exo_gravity.core.model.arm import ArmModel
from exo_gravity.sim.arm import DEFAULT_LINKS, ArmConfig

PACKAGED = 0  # the seed of the packaged simulator
WEARER_EXCESS = 1.03  # of the packaged simulator's wearer
CALIBRATED = 0.009  # largest error of a moment after `calibrate gravity`, docs/calibration.md
COULOMB, VISCOUS = (0.2, 0.4, 0.2, 0.2), (0.02, 0.05, 0.02, 0.02)  # Nm, Nm s/rad


@dataclass(frozen=True)
class PerturbedArm:
    """config: the true arm with its wearer. coulomb Nm, viscous Nm s/rad: its friction as identified, (4,) each."""

    config: ArmConfig
    coulomb: list[float]
    viscous: list[float]

    def calibrated(self, seed: int) -> tuple[ArmModel, np.ndarray]:
        """Return the robot and the wearer's masses (4,) as a calibration finds them: within `CALIBRATED`."""
        rng = np.random.default_rng(seed)
        links = self.config.links
        robot, worn = (1.0 + rng.uniform(-CALIBRATED, CALIBRATED, 4) for _ in range(2))
        return ArmModel(links.length, links.cog, robot * links.mass), worn * np.array(self.config.wearer_mass)


def perturbed_arm(seed: int, wearer_mass: Sequence[float], wearer_cog: Sequence[float]) -> PerturbedArm:
    """Return the packaged simulator for seed 0, else a random arm: masses, friction and wearer differ.

    wearer_mass kg, wearer_cog m: (4,) each, as the controller knows the wearer.
    """
    if seed == PACKAGED:
        worn = WEARER_EXCESS * np.array(wearer_mass)
        config = ArmConfig(
            wearer_mass=worn.tolist(), wearer_cog=wearer_cog, coulomb_friction=COULOMB, viscous_friction=VISCOUS
        )
        return PerturbedArm(config, list(COULOMB), list(VISCOUS))
    rng = np.random.default_rng(seed)
    mass, cog = DEFAULT_LINKS.mass * rng.uniform(0.95, 1.05, 4), DEFAULT_LINKS.cog * rng.uniform(0.95, 1.0, 4)
    coulomb = np.array(COULOMB) * rng.uniform(0.7, 1.3, 4)
    viscous = np.array(VISCOUS) * rng.uniform(0.7, 1.3, 4)
    identified = rng.uniform(0.8, 1.0)
    config = ArmConfig(
        ArmModel(DEFAULT_LINKS.length, cog, mass),
        wearer_mass=(rng.uniform(0.95, 1.05) * np.array(wearer_mass)).tolist(),
        wearer_cog=wearer_cog,
        coulomb_friction=coulomb.tolist(),
        viscous_friction=viscous.tolist(),
    )
    return PerturbedArm(config, (identified * coulomb).tolist(), (identified * viscous).tolist())
