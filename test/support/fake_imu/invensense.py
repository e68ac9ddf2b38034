"""Models of the MPU-6050 and the MPU-9250 by RM-MPU-6000A and RM-MPU-9250A, and what the ICM-20948 shares."""

from __future__ import annotations

from collections.abc import Callable

from .chip import Axes, Motion, Sampler, high_first, number


class FakeInvenSense:
    """A FIFO of bytes that the oldest leave first; data registers; self-test; sleep after a reset."""

    capacity = 512
    reset_values: dict[int, int]
    response: tuple[Axes, Axes] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """What the actuators add: deg/s and g."""

    def __init__(self, clock: Callable[[], float], motion: Motion | None = None, fast: float = 1.0) -> None:
        self.motion = motion or Motion()
        self.sampler = Sampler(clock, fast)
        self.overflowed = False
        self.fifo: list[int] = []
        self._latest: list[int] = [0] * 6
        self._last_byte = 0xFF
        self.registers: dict[int, int] = {}
        self.reset()

    def reset(self) -> None:
        """Return to the reset values."""
        self.registers = dict(self.reset_values)
        self.fifo.clear()
        self.overflowed = False
        self.sampler.restart()

    def run(self) -> None:
        """Take the samples that are due."""
        for instant in self.sampler.due(self.rate()):
            self._latest = [
                *(number(value * self.lsb_per_g()) for value in self._with_actuators(instant, 1)),
                *(number(value * self.lsb_per_dps()) for value in self._with_actuators(instant, 0)),
            ]
            queued = (self._latest[:3] if self.queues()[0] else []) + (self._latest[3:] if self.queues()[1] else [])
            self.fifo += high_first(queued)
            if len(self.fifo) > self.capacity:
                self.overflowed = True
                del self.fifo[: -self.capacity]

    def pop(self) -> int:
        """Return the FIFO's oldest byte; an empty FIFO repeats the last one."""
        if self.fifo:
            self._last_byte = self.fifo.pop(0)
        return self._last_byte

    def data(self) -> list[int]:
        """Return the 12 bytes of the acceleration's and the angular velocity's data registers."""
        return high_first(self._latest)

    def _with_actuators(self, instant: float, sensor: int) -> list[float]:
        source = (self.motion.angular_velocity, self.motion.acceleration)[sensor]
        on = self.actuators()[sensor]
        return [value + on * extra for value, extra in zip(source(instant), self.response[sensor], strict=True)]

    def rate(self) -> float:
        """Return samples a second, 0 asleep."""
        raise NotImplementedError

    def lsb_per_dps(self) -> float:
        """Return the gyroscope's scale."""
        raise NotImplementedError

    def lsb_per_g(self) -> float:
        """Return the accelerometer's scale."""
        raise NotImplementedError

    def queues(self) -> tuple[bool, bool]:
        """Return whether accelerometer and gyroscope go to the FIFO."""
        raise NotImplementedError

    def actuators(self) -> tuple[bool, bool]:
        """Return whether the self-test of gyroscope and accelerometer is on."""
        raise NotImplementedError


class FakeMpu6050(FakeInvenSense):
    """An MPU-6050; with `who_am_i` 0x71 an MPU-9250, whose codes of the self-test lie elsewhere."""

    # XG_TEST 20, YG_TEST 15, ZG_TEST 17; XA_TEST 0b10110, YA_TEST 0b01101, ZA_TEST 0b10001: high bits, low bits
    codes_6050 = (20 | 0b101 << 5, 15 | 0b011 << 5, 17 | 0b100 << 5, 0b10_01_01)
    codes_9250 = ((200, 190, 180), (160, 170, 150))

    def __init__(
        self,
        clock: Callable[[], float],
        motion: Motion | None = None,
        fast: float = 1.0,
        who_am_i: int = 0x68,
        response: float = 1.0,
    ) -> None:
        self.is_6050 = who_am_i == 0x68
        self.capacity = 1024 if self.is_6050 else 512
        self.reset_values = {0x6B: 0x40 if self.is_6050 else 0x01, 0x75: who_am_i}
        if self.is_6050:
            self.reset_values |= {0x0D + index: code for index, code in enumerate(self.codes_6050)}
            gyro = [sign * 25.0 * 1.046 ** (code - 1) for sign, code in ((1, 20), (-1, 15), (1, 17))]
            accel = [0.34 * (0.92 / 0.34) ** ((code - 1) / 30) for code in (0b10110, 0b01101, 0b10001)]
        else:
            for start, codes in zip((0x00, 0x0D), self.codes_9250, strict=True):
                self.reset_values |= {start + index: code for index, code in enumerate(codes)}
            gyro = [2620 * 1.01 ** (code - 1) / 131.0 for code in self.codes_9250[0]]
            accel = [2620 * 1.01 ** (code - 1) / 16384.0 for code in self.codes_9250[1]]
        x, y, z = (value * response for value in gyro)
        u, v, w = (value * response for value in accel)
        self.response = ((x, y, z), (u, v, w))
        super().__init__(clock, motion, fast)

    def read(self, register: int, length: int) -> list[int]:
        """Return bytes; FIFO_R_W does not move on, the other registers do."""
        self.run()
        if register == 0x74:
            return [self.pop() for _ in range(length)]
        return [self._byte(register + offset) for offset in range(length)]

    def write(self, register: int, value: int) -> None:
        """Take one byte."""
        self.run()
        if register == 0x6B and value & 0x80:
            self.reset()
        elif register == 0x6A:
            if value & 0x04 and not value & 0x40:  # FIFO_RESET works while FIFO_EN is 0
                self.fifo.clear()
            self.registers[register] = value & ~0x07
        elif register not in (0x75, *range(0x3A, 0x49)):
            self.registers[register] = value

    def _byte(self, register: int) -> int:
        if register == 0x72:
            return len(self.fifo) >> 8
        if register == 0x73:
            return len(self.fifo) & 0xFF
        if 0x3B <= register <= 0x40:
            return self.data()[register - 0x3B]
        if 0x43 <= register <= 0x48:
            return self.data()[register - 0x43 + 6]
        if register in (0x41, 0x42):
            celsius = self.motion.temperature
            raw = (celsius - 36.53) * 340.0 if self.is_6050 else (celsius - 21.0) * 333.87
            return high_first([number(raw)])[register - 0x41]
        return self.registers.get(register, 0)

    def rate(self) -> float:
        """Return samples a second: 1 kHz with the low-pass filter, 8 kHz without, divided."""
        if self.registers[0x6B] & 0x40:
            return 0.0
        filtered = 1 <= self.registers.get(0x1A, 0) & 0x07 <= 6
        return (1000.0 if filtered else 8000.0) / (1 + self.registers.get(0x19, 0))

    def lsb_per_dps(self) -> float:
        """Return the gyroscope's scale by FS_SEL."""
        return float((131.0, 65.5, 32.8, 16.4)[self.registers.get(0x1B, 0) >> 3 & 3])

    def lsb_per_g(self) -> float:
        """Return the accelerometer's scale by AFS_SEL."""
        return float(16384 >> (self.registers.get(0x1C, 0) >> 3 & 3))

    def queues(self) -> tuple[bool, bool]:
        """Return FIFO_EN, if USER_CTRL enables the FIFO."""
        enabled, selected = self.registers.get(0x6A, 0) & 0x40, self.registers.get(0x23, 0)
        return bool(enabled and selected & 0x08), bool(enabled and selected & 0x70 == 0x70)

    def actuators(self) -> tuple[bool, bool]:
        """Return whether all three axes of a sensor are tested."""
        return self.registers.get(0x1B, 0) & 0xE0 == 0xE0, self.registers.get(0x1C, 0) & 0xE0 == 0xE0
