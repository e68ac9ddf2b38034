"""A recording -> a clip: the arms as they moved, their torques and limits, and a caption with time, step and torques.

The arms are drawn in the trunk's axes, from the parameters that the recording holds. A GIF has one palette for all
frames, which keeps it small.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import imageio.v3 as iio
import numpy as np
import yaml
from PIL import Image, ImageDraw, ImageFont

from exo_gravity.bag.content import Bag
from exo_gravity.core.compensation.params import COMPENSATOR
from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.params import Param
from exo_gravity.core.safety.drive import State
from exo_gravity.core.safety.params import CAN_BRIDGE
from exo_gravity.core.trial.recording import Recording
from exo_gravity.core.view.arm_description import ArmDescription, described
from exo_gravity.core.view.scene import AMBER, GREEN, GREY, RED, ArmView, Shape, arm_shapes
from exo_gravity.tools.video.output import Clip, frame_times
from exo_gravity.tools.video.stage import Stage

WIDTH, HEIGHT = 640, 480
GIF_WIDTH, GIF_HEIGHT, COLOURS = 480, 360, 128
LINE_HEIGHT = 0.042  # of the picture's height
INK = (40, 44, 52)
SWATCH = 12  # pixels
NO_TORQUE = 0.05  # Nm, below which a motor counts as off
STEPS = {"move": "the wearer moves the arm", "hold": "hands off", "push": "a push"}

OnFrame = Callable[[int, int], None]  # (frames done, frames in total)


def write_clip(bag: Bag, clip: Clip, on_frame: OnFrame = lambda done, count: None) -> None:
    """Write the clip of a recording. Raises DataError if its arms are not described, or it cannot be drawn."""
    arms = [_description(bag.parameters, recording.name) for recording in bag.recordings]
    is_gif = clip.path.suffix.lower() == ".gif"
    size = (GIF_WIDTH, GIF_HEIGHT) if is_gif else (WIDTH, HEIGHT)
    try:
        stage = Stage(arms, *size)
    except ParameterError as error:
        raise DataError(f"{bag.path}: {error}") from None
    times = frame_times(min(float(recording.time[-1]) for recording in bag.recordings), clip)
    pictures = _pictures(stage, list(zip(arms, bag.recordings, strict=True)), times, on_frame)
    try:
        _write_gif(pictures, clip) if is_gif else _write_mp4(pictures, clip)
    except OSError as error:
        raise DataError(f"{clip.path}: cannot be written ({error.strerror or error})") from None
    finally:
        stage.close()


def _pictures(
    stage: Stage, arms: Sequence[tuple[ArmDescription, Recording]], times: Sequence[float], on_frame: OnFrame
) -> Iterator[Image.Image]:
    for i, time in enumerate(times):
        views = [_view(arm, recording, time) for arm, recording in arms]
        shapes: list[Shape] = [shape for view in views for shape in arm_shapes(view)]
        picture = Image.fromarray(stage.frame([angle for view in views for angle in view.theta], shapes))
        _write_caption(picture, [f"{time:.1f} s  {_step(arms[0][1], time)}", *map(_torques, views)])
        on_frame(i + 1, len(times))
        yield picture


def _view(arm: ArmDescription, recording: Recording, time: float) -> ArmView:
    """Return what is known of an arm at `time` s."""
    at = min(int(np.searchsorted(recording.time, time)), len(recording.time) - 1)
    order = [recording.joint_names.index(name) for name in arm.limits.joint_names]
    theta, velocity, effort = (
        np.nan_to_num(row[at, order].astype(float)).tolist()
        for row in (recording.position, recording.velocity, recording.effort)
    )
    powered = State.LETTING_DOWN if max(map(abs, effort)) > NO_TORQUE else State.DISABLED
    state = State.ACTIVE if _is_carried(recording, time) else powered
    return ArmView(arm, theta, velocity, effort, state.value)


def _is_carried(recording: Recording, time: float) -> bool:
    return recording.carried is None or any(start <= time <= end for start, end in recording.carried)


def _step(recording: Recording, time: float) -> str:
    """Return what the script does at `time` s."""
    for step in recording.steps:
        if step.start <= time < step.end:
            return STEPS.get(step.action, step.action)
    if _is_carried(recording, time):
        return "carried"
    return "let down" if recording.carried and time > recording.carried[0][0] else "start-up checks"


def _torques(view: ArmView) -> str:
    return f"{view.arm.side} " + " ".join(f"{round(effort, 2) + 0.0:.2f}" for effort in view.effort) + " Nm"


def _write_caption(picture: Image.Image, lines: Sequence[str]) -> None:
    height = LINE_HEIGHT * picture.height
    font, draw = ImageFont.load_default(height), ImageDraw.Draw(picture)
    for i, line in enumerate(lines):
        draw.text((height / 2, height / 2 + 1.2 * height * i), line, INK, font)


def _write_mp4(pictures: Iterator[Image.Image], clip: Clip) -> None:
    with iio.imopen(clip.path, "w", plugin="pyav") as file:
        file.init_video_stream("libx264", fps=clip.frame_rate)
        for picture in pictures:
            file.write_frame(np.asarray(picture))


def _write_gif(pictures: Iterator[Image.Image], clip: Clip) -> None:
    """Write frames in one palette; Pillow stores of each frame only what has changed."""
    first = next(pictures)
    palette = _palette(first)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in (first, *pictures)]
    frames[0].save(clip.path, save_all=True, append_images=frames[1:], duration=round(1000 / clip.frame_rate), loop=0)


def _palette(picture: Image.Image) -> Image.Image:
    """Return the colours of a picture and those of torques and states, which it may not show yet."""
    sample = picture.copy()
    draw = ImageDraw.Draw(sample)
    for i, colour in enumerate((GREEN, AMBER, RED, GREY)):
        for j, share in enumerate((0.5, 0.75, 1.0)):  # in shade and in light
            corner = SWATCH * i, SWATCH * j
            shade = tuple(round(255 * share * part) for part in colour[:3])
            draw.rectangle((*corner, corner[0] + SWATCH, corner[1] + SWATCH), shade)
    return sample.quantize(COLOURS, dither=Image.Dither.NONE)


def _description(parameters: Mapping[str, str], name: str) -> ArmDescription:
    """Return the arm `name` of a recording from the nodes' parameters in it. Raises DataError."""
    namespace = "" if name == "arm" else f"/{name}"
    try:
        values = [
            _values(parameters, f"{namespace}/{node}", table)
            for node, table in (("compensator", COMPENSATOR), ("can_bridge", CAN_BRIDGE))
        ]
        return described(*values)
    except ParameterError as error:
        raise DataError(f"{name}: the recording's parameters do not describe the arm: {error}") from None


def _values(parameters: Mapping[str, str], node: str, table: Sequence[Param]) -> dict[str, Any]:
    """Return the recorded parameters of `node`; the default for one that its version did not have."""
    text = parameters.get(node)
    if text is None:
        raise ParameterError("parameters", sorted(parameters), f"those of {node} among others")
    given = yaml.safe_load(text)[node]["ros__parameters"]
    return {param.name: given.get(param.name, param.default) for param in table}
