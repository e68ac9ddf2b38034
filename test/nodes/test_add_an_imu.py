# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""CONTRIBUTING, "Add an IMU", followed literally: a class with `read` and `close`, and its name in two places."""

import pytest

from exo_gravity.core.trunk.imu_checks import ImuSample
from exo_gravity.core.trunk.params import IMU_SOURCES
from exo_gravity.hardware.imu_sources import SOURCES, ImuSource
from exo_gravity.nodes.imu import ImuDevice
from exo_gravity.sim.virtual_time import VirtualClock


class LevelImu(ImuSource):
    """A sensor that always lies level."""

    def __init__(self, values, clock):
        super().__init__(f"level IMU at {values['rate']:g} Hz")
        self.clock, self.is_open = clock, True

    def read(self):
        return [ImuSample(self.clock(), (0.0, 0.0, 0.01), (0.0, 0.0, 9.81))]

    def close(self):
        self.is_open = False


def test_a_new_source_is_opened_by_its_name_and_its_samples_reach_the_node(monkeypatch, node):
    monkeypatch.setitem(SOURCES, "level", LevelImu)
    clock, received = VirtualClock(), []
    values = {"source": "level", "rate": 100.0}
    device = ImuDevice(node, values, "/imu/data_raw", lambda message, info: received.append(message), clock)
    for _ in range(3):
        clock.sleep(0.01)
        device.poll()
    assert [message.linear_acceleration.z for message in received] == pytest.approx([9.81] * 3)
    assert received[0].orientation_covariance[0] == -1.0  # not reported
    assert device.values["device"] == "level IMU at 100 Hz"
    source = device.reopening.source
    device.reopening.close()
    assert not source.is_open


def test_each_source_is_a_choice_of_the_parameter():
    assert set(IMU_SOURCES) == {"topic", *SOURCES}
