# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Clips: what the command line accepts, and the frames of an offline trial, drawn in a separate process.

MuJoCo chooses how it draws when it is imported, which other tests have done in this process.
"""

import subprocess
import sys

import imageio.v3 as iio
import numpy as np
import pytest

from exo_gravity.core.errors import ParameterError
from exo_gravity.lab.inputs.parameter_file import packaged_config
from exo_gravity.lab.report import video as output
from exo_gravity.lab.report.video import NO_GRAPHICS, backend, requested

SCRIPT = """
name: short
steps:
  - {move: [0.0, 0.8, 0.6, 0.4], over: 1.0}
  - {hold: 2.0}
"""
COLOURFUL = 60  # difference of two channels from which a pixel is not grey


@pytest.fixture
def drawable(monkeypatch):
    """A machine that can draw, whatever this one can."""
    monkeypatch.setattr(output, "find_library", lambda name: name)


@pytest.mark.parametrize(
    ("video", "speed", "expected"),
    [
        ("clip.avi", 1.0, "a file that ends with .mp4 or .gif"),
        ("clip", 1.0, "a file that ends with .mp4 or .gif"),
        ("missing/clip.gif", 1.0, "a file in a folder that exists"),
        ("clip.gif", 0.0, "a number from 0.1 to 100"),
        ("clip.gif", float("nan"), "a number from 0.1 to 100"),
    ],
)
def test_a_wrong_clip_is_refused_before_the_trial(drawable, tmp_path, video, speed, expected):
    with pytest.raises(ParameterError, match=expected):
        requested(str(tmp_path / video), speed)


def test_a_missing_package_is_named_with_its_extra(drawable, tmp_path, monkeypatch):
    monkeypatch.setattr(output, "NEEDED", ("no_such_encoder",))
    with pytest.raises(ParameterError, match=r"no_such_encoder .*\.\[video\]"):
        requested(str(tmp_path / "clip.gif"), 1.0)


@pytest.mark.parametrize(("installed", "expected"), [({"EGL", "OSMesa"}, "egl"), ({"OSMesa"}, "osmesa")])
def test_egl_is_preferred_to_osmesa_and_mujoco_gl_to_both(monkeypatch, installed, expected):
    monkeypatch.setattr(output, "find_library", lambda name: name if name in installed else None)
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert backend() == expected
    for name in ("osmesa", "glfw"):
        monkeypatch.setenv("MUJOCO_GL", name)
        assert backend() == name


@pytest.mark.parametrize("chosen", ["disabled", "egl", "osmesa"])
def test_without_opengl_the_error_names_the_packages(tmp_path, monkeypatch, chosen):
    monkeypatch.setattr(output, "find_library", lambda name: None)
    monkeypatch.setenv("MUJOCO_GL", chosen)
    with pytest.raises(ParameterError, match="apt install libegl1"):
        requested(str(tmp_path / "clip.gif"), 1.0)


def test_from_frame_to_frame_the_recording_goes_on_at_the_speed_of_the_clip(drawable, tmp_path):
    assert requested(None, 1.0) is None
    assert requested(str(tmp_path / "clip.gif"), 4.0).step == pytest.approx(0.4)
    assert requested(str(tmp_path / "clip.mp4"), 4.0).step == pytest.approx(0.16)


def colourful(frame):
    """Return how many pixels are not grey: torques, states and centres of gravity."""
    pixels = frame[..., :3].astype(int)
    return int(np.count_nonzero(pixels.max(axis=-1) - pixels.min(axis=-1) > COLOURFUL))


@pytest.mark.thorough
@pytest.mark.timeout(300)  # software rendering on a busy machine
@pytest.mark.parametrize(("kind", "speed"), [("gif", "20"), ("mp4", "50")])  # a frame every 2 s
def test_a_clip_of_an_offline_trial_shows_the_arm_move_and_its_torques(tmp_path, kind, speed):
    script, clip = tmp_path / "short.yaml", tmp_path / f"clip.{kind}"
    script.write_text(SCRIPT, encoding="utf-8")
    words = [str(script), "--offline", "--params", str(packaged_config("sim.yaml")), "--output", str(tmp_path)]
    words += ["--video", str(clip), "--video-speed", speed]
    code = f"from exo_gravity.tools.trial import main; raise SystemExit(main({words}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280, check=False)
    if not backend():  # a machine without OpenGL
        assert (done.returncode, NO_GRAPHICS in done.stderr) == (2, True)
        return
    assert done.returncode == 0, done.stdout + done.stderr
    frames = iio.imread(clip, plugin="pillow" if kind == "gif" else "pyav")
    assert 8 <= len(frames) <= 12
    held = frames[5]  # at 10 s
    assert np.count_nonzero(np.any(held != frames[0], axis=-1)) > 0.01 * held.shape[0] * held.shape[1]
    assert colourful(held) > 1.5 * colourful(frames[0])
