"""Model of the LSM6DSOX by its data sheet DS12814: a FIFO of 512 tagged words, self-test, software reset."""

from __future__ import annotations

from collections.abc import Callable

from .chip import Axes, Motion, Sampler, low_first, number

RESET_VALUES = {0x0F: 0x6C, 0x12: 0x04, 0x18: 0xE0}
RATES = {1: 12.5, 2: 26.0, 3: 52.0, 4: 104.0, 5: 208.0, 6: 416.0, 7: 833.0, 8: 1666.0}
MG_PER_LSB = (0.061, 0.488, 0.122, 0.244)  # by FS_XL
MDPS_PER_LSB = (8.75, 17.5, 35.0, 70.0)  # by FS_G
WORDS = 512


class FakeLsm6dsox:
    """An LSM6DSOX. `response`: what the actuators add, deg/s and mg."""

    def __init__(
        self,
        clock: Callable[[], float],
        motion: Motion | None = None,
        fast: float = 1.0,
        response: tuple[Axes, Axes] = ((400.0, 350.0, 300.0), (500.0, 400.0, 900.0)),
    ) -> None:
        self.motion = motion or Motion()
        self.response = response
        self.sampler = Sampler(clock, fast)
        self.fifo: list[list[int]] = []
        self.registers = dict(RESET_VALUES)
        self._clock = clock
        self._reset_until = 0.0
        self._slot = 0
        self._overrun_latched = False
        self._latest = {"gyroscope": [0] * 3, "accelerometer": [0] * 3}
        self.sampler.restart()

    def reset(self) -> None:
        """Return to the reset values, in which it sleeps."""
        self.registers = dict(RESET_VALUES)
        self.fifo.clear()

    def read(self, register: int, length: int) -> list[int]:
        """Return bytes; from the FIFO's last register the address returns to its first one."""
        self._run()
        data = []
        for _ in range(length):
            data.append(self._byte(register))
            register = 0x78 if register == 0x7E else register + 1
        return data

    def write(self, register: int, value: int) -> None:
        """Take one byte."""
        self._run()
        if register == 0x12 and value & 0x01:
            self.reset()
            self._reset_until = self._clock() + 0.015
        elif register not in (0x0F, 0x3A, 0x3B):
            self.registers[register] = value
            if register == 0x0A and value & 0x07 == 0:  # bypass empties the FIFO
                self.fifo.clear()
                self._overrun_latched = False

    def _byte(self, register: int) -> int:
        if register == 0x12:
            return self.registers[0x12] | (self._clock() < self._reset_until)
        if register == 0x3A:
            return len(self.fifo) & 0xFF
        if register == 0x3B:
            latched, self._overrun_latched = self._overrun_latched, False
            full = len(self.fifo) >= WORDS
            return len(self.fifo) >> 8 & 0x03 | full << 6 | latched << 3
        if register in (0x20, 0x21):
            return low_first([number((self.motion.temperature - 25.0) * 256)])[register - 0x20]
        if 0x22 <= register <= 0x27:
            return low_first(self._latest["gyroscope"])[register - 0x22]
        if 0x28 <= register <= 0x2D:
            return low_first(self._latest["accelerometer"])[register - 0x28]
        if 0x78 <= register <= 0x7E:
            if not self.fifo:
                return 0
            return self.fifo[0][register - 0x78] if register < 0x7E else self.fifo.pop(0)[6]
        return self.registers.get(register, 0)

    def _run(self) -> None:
        codes = self.registers.get(0x10, 0) >> 4, self.registers.get(0x11, 0) >> 4
        for instant in self.sampler.due(max(RATES.get(code, 0.0) for code in codes)):
            test = self.registers.get(0x14, 0)
            if codes[0]:
                scale = MG_PER_LSB[self.registers[0x10] >> 2 & 3]
                extra = self.response[1] if test & 0x03 == 0x01 else (0.0, 0.0, 0.0)
                values = zip(self.motion.acceleration(instant), extra, strict=True)
                self._latest["accelerometer"] = [number((1000.0 * g + mg) / scale) for g, mg in values]
            if codes[1]:
                scale = MDPS_PER_LSB[self.registers[0x11] >> 2 & 3]
                extra = self.response[0] if test & 0x0C == 0x04 else (0.0, 0.0, 0.0)
                values = zip(self.motion.angular_velocity(instant), extra, strict=True)
                self._latest["gyroscope"] = [number(1000.0 * (dps + more) / scale) for dps, more in values]
            self._batch()

    def _batch(self) -> None:
        if self.registers.get(0x0A, 0) & 0x07 != 0x06:
            return
        self._slot = (self._slot + 1) % 4
        batches = self.registers.get(0x09, 0)
        for tag, sensor, rate in ((1, "gyroscope", batches >> 4), (2, "accelerometer", batches & 0x0F)):
            if rate:
                head = tag << 3 | self._slot << 1
                head |= head.bit_count() & 1  # even parity
                self.fifo.append([head, *low_first(self._latest[sensor])])
        if len(self.fifo) > WORDS:
            self._overrun_latched = True
            del self.fifo[:-WORDS]
