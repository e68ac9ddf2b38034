# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""The panel as a process with the simulated device, driven by a real browser."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from exo_gravity.lab.bag.reader import read_bag
from exo_gravity.lab.bag.storage import Storage
from exo_gravity.lab.inputs.parameter_file import load

from ..support.launched_nodes import LaunchedNodes
from ..support.ros_probe import RosProbe
from ..support.synthetic_bags import STORE

pytest.importorskip("playwright", reason="no browser driver: install the extra test")

from playwright.sync_api import Page

from ..support.panel_browser import IN_BROWSER, chromium, enable, open_page, wait_for_state

pytestmark = [*IN_BROWSER, pytest.mark.real_time]


RECORDING = 50_000  # bytes of a file into which joint states are written


@pytest.fixture
def clinic(tmp_path: Path) -> Iterator[tuple[LaunchedNodes, RosProbe, Page]]:
    """The nodes of the right arm, which is carried, with trials; a probe, and the open page."""
    (tmp_path / "scripts").mkdir()
    (tmp_path / "scripts" / "long.yaml").write_text(
        yaml.safe_dump({"name": "long", "steps": [{"move": [0.0, 0.3, 0.3, 0.3], "over": 1.0}, {"hold": 120.0}]})
    )
    (tmp_path / "away.yaml").write_text(
        yaml.safe_dump(
            {"name": "away", "steps": [{"move": [0.0, 0.9, 0.6, 0.8], "over": over} for over in (2.0, 60.0)]}
        )
    )
    nodes = LaunchedNodes(tmp_path, compensator={"wearer": {"body_mass": 60.0}, "support": 0.0}, wearer=True)
    url = nodes.add_panel(trials=str(tmp_path / "scripts"))
    nodes.start()
    probe = RosProbe()
    try:
        with chromium(gives_way=True) as browser:
            probe.wait_until(lambda: any("the panel is at" in line for line in nodes.log))
            page = open_page(browser, url)
            probe.get_carried()  # last: a browser that starts can stall the simulated device
            yield nodes, probe, page
    finally:
        probe.close()
        nodes.stop()
        print("\n".join(nodes.log))


def test_a_session_is_recorded_and_reported_an_arm_put_back_and_the_panels_death_changes_nothing(clinic, tmp_path):
    (nodes, probe, page), out = clinic, tmp_path / "out"
    page.click("#record")
    page.wait_for_selector("#record-stop:enabled")
    probe.wait_until(lambda: any(path.stat().st_size > RECORDING for path in out.glob("recording_*/bag/*.mcap")))
    page.click('[data-mode="zero_g"]')
    page.click("#ask-yes")
    probe.wait_until(lambda: probe.diagnostic("compensator", "mode") == "zero_g")
    page.press(".support input:enabled", "ArrowRight")
    probe.wait_until(lambda: float(probe.diagnostic("compensator", "support") or 0.0) == pytest.approx(0.005))
    page.keyboard.press("Space")
    wait_for_state(page, "disabled")
    page.click("#record-stop")
    page.wait_for_selector("#record:enabled")
    (recording,) = out.glob("recording_*")
    arrays = [
        STORE.deserialize_cdr(data, "diagnostic_msgs/msg/DiagnosticArray")
        for rows in Storage(recording / "bag").rows(lambda topic, _: topic == "/diagnostics")
        for data in rows.data
    ]
    noted = [status.message for array in arrays for status in array.status if status.name == "panel"]
    assert any("page 1: let down: done" in text for text in noted), noted
    page.click("#save")
    page.wait_for_selector("#saved:has-text('params.yaml')")
    (saved,) = out.glob("parameters_*/params.yaml")
    assert load(saved)["/right/compensator"]["mode"] == "zero_g"
    # An arm that hangs astray is put back.
    assert probe.set_parameters("simulator", trial=str(tmp_path / "away.yaml")).successful
    probe.wait_until(lambda: probe.joint_states[-1].position[1] > 0.8)
    page.click(".home")
    probe.wait_until(lambda: max(map(abs, probe.joint_states[-1].position)) < 0.15)
    # A trial of a subject, with a marker, is stopped and reported.
    page.fill("#session [name=subject]", "P01")
    page.click("#session button:not([type])")
    page.wait_for_selector("#session-text:has-text('P01')")
    enable(page)
    wait_for_state(page, "active")
    page.select_option("#trials", "long")
    page.click("#trial-start")
    page.wait_for_selector("#trial-step:has-text('Hands off')")
    page.keyboard.press("m")
    page.wait_for_selector("#message:has-text('marker')")
    page.click("#trial-stop")
    page.wait_for_selector("#trial-report:visible")
    (trial,) = out.glob("P01/*-*-*/long_*")
    bag = read_bag(trial / "bag")
    assert bag.session.subject == "P01" and [marker.text for marker in bag.markers] == ["marker"]
    assert "stopped by the operator" in (trial / "report.html").read_text(encoding="utf-8")
    assert any("wearer: done" in line for line in nodes.log)
    nodes.process("/panel").kill()
    wait_for_state(page, "unseen")
    seen = len(probe.joint_states)
    probe.wait_until(lambda: len(probe.joint_states) > seen + 200)  # 2 s
    assert probe.state == "active" and not nodes.have_ended
