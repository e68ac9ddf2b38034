"""What the sensors on serial ports share: packets in, measurements out."""

from __future__ import annotations

from exo_gravity.hardware.imu_sources.sampled_source import Measurement, SampledSource
from exo_gravity.hardware.imu_sources.serial_port import Packets, SerialPort
from exo_gravity.hardware.imu_sources.source import Clock


class SerialSource(SampledSource):
    """Base of the sensors on serial ports; a sensor's class decodes its packets."""

    def __init__(self, port: SerialPort, packets: Packets, rate: float, clock: Clock) -> None:
        """Read from an open port."""
        super().__init__(port.name, rate, clock)
        self._port = port
        self._packets = packets
        self._damaged = 0  # packets, as last seen
        self.silence = "not one byte"

    def close(self) -> None:
        """Close the port; never raises."""
        self._port.close()

    def _measure(self, now: float) -> list[Measurement]:
        data = self._port.read()
        packets = self._packets.feed(data)
        if data:
            self.silence = "not one byte" if packets else "bytes, but no whole packet: is serial.baud the sensor's?"
        if self._packets.damaged > self._damaged:
            self._damaged = self._packets.damaged
            self._why_lost = "damaged packets"
        return [measurement for packet in packets if (measurement := self._decode(packet))]

    def _decode(self, packet: bytes) -> Measurement | None:
        """Return the measurement that a packet completes."""
        raise NotImplementedError
