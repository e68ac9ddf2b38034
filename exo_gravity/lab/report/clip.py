# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A recording -> a clip: a wearer whose arms move as they did, torques and limits, and a caption with time and step.

Everything is drawn in the trunk's axes, the arms from the parameters that the recording holds, and the wearer as a
dummy. Matplotlib draws it, so that no graphics library is needed.
"""

from itertools import pairwise
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D
from mpl_toolkits.mplot3d.proj3d import proj_transform
from PIL import Image
from rich.console import Console
from rich.progress import track

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.safety.command import State
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import node_of
from exo_gravity.lab.report.table import shown
from exo_gravity.lab.trial.analysis import Recording
from exo_gravity.lab.view import COLOURS, LINE, SPHERE, ArmView, Described, arm_shapes, described
from exo_gravity.lab.vocabulary import of_all

SIZE, GIF_SIZE, DPI = (6.4, 4.8), (4.8, 3.6), 100  # inches
INK, LEADER = "#282c34", "#969ca4"
NO_TORQUE = 0.05  # Nm, below which a motor is off
STEPS = {"move": "the wearer moves the arm", "hold": "hands off", "push": "a push"}
AZIMUTH, ELEVATION = {"left": 35.0, "right": -35.0, "both": -15.0}, 8.0  # deg, of the viewer: in front of the wearer
FROM, TO = np.array((-0.6, -0.6, -0.85)), np.array((0.6, 0.6, 0.35))  # m from the shoulders, what is seen
ZOOM, SCALE = 1.4, 0.69  # and how large, in heights of the picture for 1 m
BODY, LIMB = "#ccc2b2", (0.80, 0.70, 0.62, 0.35)  # the wearer, and the arms that are worn
# Parts of the wearer between two points in m, relative to the middle of the shoulders, and their diameters. Those that
# have a breadth stand on both sides.
DUMMY = (
    ((0.0, 0.0, 0.02), (0.0, 0.0, 0.12), 0.10),
    ((0.02, 0.0, 0.18), (0.0, 0.0, 0.24), 0.17),
    ((0.0, 0.06, -0.07), (0.0, 0.05, -0.30), 0.19),
    ((0.0, 0.11, -0.05), (0.0, 0.06, -0.16), 0.13),
    ((0.0, 0.05, -0.30), (0.0, 0.07, -0.52), 0.18),
    ((0.0, 0.09, -0.54), (0.0, 0.10, -1.00), 0.16),
)
FREE_ARM = ((0.0, 0.18, -0.06), (-0.02, 0.22, -0.34), (0.03, 0.23, -0.62))  # m, of a side without an exoskeleton
LIMB_SIZE, TUBE, JOINT = 0.075, 0.025, 0.06  # m, the diameters of an arm, a link and a motor


def write_clip(bag: Bag, path: Path, step: float, frame_rate: int, console: Console) -> None:
    """Write a clip with a frame for every `step` s of a recording, `frame_rate` of them per second.

    Raises DataError if the recording does not describe its arms, or the clip cannot be written.
    """
    end, is_gif = min(float(recording.time[-1]) for recording in bag.recordings), path.suffix.lower() == ".gif"
    times = [step * n for n in range(int(end / step) + 1)]
    drawn = track(times, f"drawing {path.name}", console=console, transient=True, disable=not console.is_terminal)
    try:
        stage = Stage(bag, GIF_SIZE if is_gif else SIZE)
        if is_gif:
            # Few colours keep it small.
            drawings = (Image.fromarray(stage.picture(t)).quantize(64, dither=Image.Dither.NONE) for t in drawn)
            next(drawings).save(path, save_all=True, append_images=drawings, duration=round(1000 / frame_rate), loop=0)
            return
        with iio.imopen(path, "w", plugin="pyav") as file:
            file.init_video_stream("libx264", fps=frame_rate)
            for time in drawn:
                file.write_frame(stage.picture(time))
    except ParameterError as error:
        raise DataError(f"{bag.path}: {error}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error})") from None


class Stage:
    """Draws frames of `size` inches."""

    def __init__(self, bag: Bag, size: tuple[float, float]) -> None:
        self._arms = []
        for recording in bag.recordings:
            arm = _description(bag, recording.name)
            self._arms.append((arm, recording.in_order(arm.limits.joint_names)))
        source = of_all(bag.source(recording.name) for recording in bag.recordings)
        self._stamp = "SIMULATED" if source is Source.SIMULATED else ""
        sides = {arm.side for arm, _ in self._arms}
        self._side = "both" if len(sides) > 1 else sides.pop()
        self._middle = np.mean([arm.base for arm, _ in self._arms], axis=0) * (1.0, 0.0, 1.0)
        self._canvas = FigureCanvasAgg(Figure(figsize=size, dpi=DPI))
        self._axes: Axes3D = self._canvas.figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d")
        self._points = 72.0 * size[1] * SCALE  # of a line that is 1 m wide

    def picture(self, time: float) -> np.ndarray:
        """Return the picture of the recording at `time` s, (height, width, 3)."""
        self._axes.clear()
        self._axes.set_axis_off()
        self._axes.set_proj_type("ortho")
        self._axes.view_init(ELEVATION, AZIMUTH[self._side])
        low, high = self._middle + FROM, self._middle + TO
        self._axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        self._axes.set_box_aspect((1.0, 1.0, 1.0), zoom=ZOOM)
        self._draw_wearer()
        for arm, recording in self._arms:
            self._draw_arm(arm, recording, time)
        caption = f"{time:.1f} s  {_step(self._arms[0][1], time)}"
        for x, side, text in ((0.02, "left", caption), (0.98, "right", self._stamp)):
            self._axes.annotate(text, (x, 0.98), xycoords="figure fraction", ha=side, va="top", color=INK)
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _line(self, points: np.ndarray, size: float, colour: str | tuple[float, ...]) -> None:
        width = size * self._points
        marker = {"marker": "o", "ms": width} if len(points) == 1 else {"lw": width, "solid_capstyle": "round"}
        self._axes.plot(*np.transpose(points), color=colour, mew=0.0, **marker)

    def _draw_wearer(self) -> None:
        """Draw the wearer without the arms that are worn."""
        worn = {1.0 if arm.side == "left" else -1.0 for arm, _ in self._arms}
        parts = [(ends, size, {1.0, -1.0} if ends[0][1] else {1.0}) for *ends, size in DUMMY]
        parts += [(list(ends), LIMB_SIZE, {1.0, -1.0} - worn) for ends in pairwise(FREE_ARM)]
        for ends, size, sides in parts:
            for side in sides:
                self._line(self._middle + np.multiply(ends, (1.0, side, 1.0)), size, BODY)

    def _draw_arm(self, arm: Described, recording: Recording, time: float) -> None:
        """Draw an arm, what is shown around it, and the torque of each joint at the picture's edge on its side."""
        at = _sample(recording, time)
        rows = (recording.position, recording.velocity, recording.effort)
        theta, velocity, effort = (np.nan_to_num(row[at].astype(float)).tolist() for row in rows)
        powered = State.LETTING_DOWN if max(map(abs, effort)) > NO_TORQUE else State.DISABLED
        state = State.ACTIVE if recording.is_carried[at] else powered
        origins = arm.pose(theta)[0]
        self._line(origins[1:], LIMB_SIZE, LIMB)
        self._line(origins, TUBE, COLOURS["tube"])
        for origin in origins[:-1]:
            self._line(origin[None], JOINT, COLOURS["motor"])
        for shape in arm_shapes(ArmView(arm, theta, velocity, effort, state.value)):
            if shape.kind in (LINE, SPHERE):
                self._line(shape.points, shape.size, shape.colour)
        is_left = arm.side == "right"  # in front of the wearer
        names, ink = arm.limits.joint_names, {"arrowstyle": "-", "color": LEADER}
        for n, (name, torque) in enumerate(zip(names, effort, strict=True)):
            *at, _ = proj_transform(*origins[n], self._axes.get_proj())
            place = (0.02 if is_left else 0.98), 0.80 - 0.72 * n / len(names)
            label = f"{name.removeprefix(f'{arm.side}_').replace('_', ' ')}\n{shown(torque, 2)} Nm"
            self._axes.annotate(
                label, at, place, textcoords="figure fraction", ha="left" if is_left else "right", va="top", color=INK,
                arrowprops=ink,
            )  # fmt: skip


def _sample(recording: Recording, time: float) -> int:
    return min(int(np.searchsorted(recording.time, time)), len(recording.time) - 1)


def _step(recording: Recording, time: float) -> str:
    """Return what the script does at `time` s."""
    for step in recording.steps:
        if step.start <= time < step.end:
            return STEPS.get(step.action, step.action)
    if recording.is_carried[_sample(recording, time)]:
        return "carried"
    return "let down" if recording.carried and time > recording.carried[0][0] else "start-up checks"


def _description(bag: Bag, name: str) -> Described:
    """Return the arm `name` from the nodes' parameters in a recording. Raises DataError or ParameterError."""
    values = {executable: recorded_of(bag.parameters, name, executable) for executable in ("compensator", "can_bridge")}
    for executable, given in values.items():
        if not given:
            raise DataError(f"{name}: the recording has no parameters of {node_of(name, executable)}, its description")
    return described(**values)
