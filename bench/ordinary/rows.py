# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The rows: each driver of an IMU once, with ordinary motors, wire formats, rates and computers by turns.

Then the other arms of config, which have no IMU, with the same motors, rates and computers.
"""

from dataclasses import dataclass

from ..arms import ARMS, Friction
from .arm import Electronics, Equipment, OrdinaryArm, Result
from .drivers import ordinary_drivers

MARGIN = 120.0  # s; the last start may take that long
CARRIED = 24.0  # s, of each start
EQUIPMENT = (
    Equipment("quick motors", Electronics(0.001, 0.005, torque_noise=0.15), Friction(0.1, 0.1), 0.01),
    Equipment(
        "slow motors, batches",
        Electronics(0.008, 0.001, torque_noise=0.03),
        Friction(0.3, 0.2),
        loss=0.03,
        batch=0.001,
    ),
    Equipment(
        "noisy motors, busy computer",
        Electronics(0.004, 0.003, torque_noise=0.15),
        Friction(0.2, 0.1),
        loss=0.03,
        batch=0.001,
        late=0.1,
    ),
    Equipment("ideal motors, busy computer", None, Friction(0.2), late=0.1),
)
RATES = (100.0, 250.0, 500.0)  # Hz
V3_RATES = (100.0, 250.0, 400.0)  # Hz: each cycle waits for a status frame
PAPER, *OTHERS = ARMS


@dataclass(frozen=True)
class Row:
    """One arm, by its name in ARMS. rate: Hz of the control loop. driver: name of the IMU's, '' without one."""

    arm: str
    equipment: Equipment
    is_v3: bool
    rate: float
    driver: str

    @property
    def name(self) -> str:
        """What is played."""
        arm = "" if self.arm == PAPER else f"{self.arm}, "
        board = f"{'V3' if self.is_v3 else 'V1/V2'}, " if ARMS[self.arm].has_v3 else ""
        imu = f"; IMU: {self.driver}" if self.driver else ""
        return f"{arm}{self.equipment.name}; {board}{self.rate:g} Hz{imu}"

    def play(self, duration: float, carried: float = CARRIED) -> Result:
        """Play `duration` s, and until the last start has ended."""
        timing = ordinary_drivers(duration + MARGIN)[self.driver] if self.driver else None
        return OrdinaryArm(ARMS[self.arm], self.equipment, self.is_v3, self.rate, timing).play(duration, carried)


def all_rows() -> list[Row]:
    """Return every row."""
    rows = []
    for number, driver in enumerate(ordinary_drivers(1.0)):
        is_v3 = number // 4 % 2 == 1
        rate = (V3_RATES if is_v3 else RATES)[number % 3]
        rows.append(Row(PAPER, EQUIPMENT[number % 4], is_v3, rate, driver))
    for number, arm in enumerate(OTHERS):
        for turn, equipment in enumerate(EQUIPMENT):
            is_v3 = ARMS[arm].has_v3 and turn % 2 == 1
            rows.append(Row(arm, equipment, is_v3, (V3_RATES if is_v3 else RATES)[(number + turn) % 3], ""))
    return rows


def played(item: tuple[Row, float]) -> Result:
    """Play a row for so many s."""
    row, duration = item
    return row.play(duration)
