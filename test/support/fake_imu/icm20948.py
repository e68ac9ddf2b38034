"""Model of the ICM-20948 by DS-000189."""

from __future__ import annotations

from collections.abc import Callable

from .chip import Motion, high_first, number
from .invensense import FakeInvenSense


class FakeIcm20948(FakeInvenSense):
    """An ICM-20948: bank n holds the registers 0x100 * n + number; REG_BANK_SEL, 0x7F, is in every bank."""

    codes = ((200, 190, 180), (160, 170, 150))

    def __init__(
        self, clock: Callable[[], float], motion: Motion | None = None, fast: float = 1.0, response: float = 1.0
    ) -> None:
        self.bank = 0
        self.reset_values = {0x000: 0xEA, 0x005: 0x40, 0x006: 0x41, 0x214: 0x01}
        for start, codes in zip((0x102, 0x10E), self.codes, strict=True):
            self.reset_values |= {start + index: code for index, code in enumerate(codes)}
        x, y, z = (response * 2620 * 1.01 ** (code - 1) / 131.0 for code in self.codes[0])
        u, v, w = (response * 2620 * 1.01 ** (code - 1) / 16384.0 for code in self.codes[1])
        self.response = ((x, y, z), (u, v, w))
        super().__init__(clock, motion, fast)

    def read(self, register: int, length: int) -> list[int]:
        """Return bytes; FIFO_R_W does not move on, the other registers do."""
        self.run()
        if self.bank == 0 and register == 0x72:
            return [self.pop() for _ in range(length)]
        return [self._byte(0x100 * self.bank + register + offset) for offset in range(length)]

    def write(self, register: int, value: int) -> None:
        """Take one byte."""
        self.run()
        if register == 0x7F:
            self.bank = value >> 4 & 3
            return
        register += 0x100 * self.bank
        if register == 0x006 and value & 0x80:
            self.bank = 0
            self.reset()
        elif register == 0x068 and value & 0x1F:  # FIFO_RST
            self.fifo.clear()
            self.registers[register] = value
        elif register not in (0x000, *range(0x02D, 0x03B)):
            self.registers[register] = value

    def _byte(self, register: int) -> int:
        if register == 0x070:
            return len(self.fifo) >> 8
        if register == 0x071:
            return len(self.fifo) & 0xFF
        if 0x02D <= register <= 0x038:
            return self.data()[register - 0x02D]
        if register in (0x039, 0x03A):
            return high_first([number((self.motion.temperature - 21.0) * 333.87)])[register - 0x039]
        return self.registers.get(register, 0)

    def rate(self) -> float:
        """Return samples a second: 1125 Hz divided, if both sensors agree on it."""
        divider, low = self.registers.get(0x200, 0), self.registers.get(0x211, 0)
        high = self.registers.get(0x210, 0) & 0x0F
        if self.registers[0x006] & 0x40 or divider != high << 8 | low:
            return 0.0
        return 1125.0 / (1 + divider)

    def lsb_per_dps(self) -> float:
        """Return the gyroscope's scale by GYRO_FS_SEL."""
        return float((131.0, 65.5, 32.8, 16.4)[self.registers.get(0x201, 0) >> 1 & 3])

    def lsb_per_g(self) -> float:
        """Return the accelerometer's scale by ACCEL_FS_SEL."""
        return float(16384 >> (self.registers.get(0x214, 0) >> 1 & 3))

    def queues(self) -> tuple[bool, bool]:
        """Return FIFO_EN_2, if USER_CTRL enables the FIFO and FIFO_RST is released."""
        enabled = self.registers.get(0x003, 0) & 0x40 and not self.registers.get(0x068, 0) & 0x1F
        selected = self.registers.get(0x067, 0)
        return bool(enabled and selected & 0x10), bool(enabled and selected & 0x0E == 0x0E)

    def actuators(self) -> tuple[bool, bool]:
        """Return whether all three axes of a sensor are tested."""
        return self.registers.get(0x202, 0) & 0x38 == 0x38, self.registers.get(0x215, 0) & 0x1C == 0x1C
