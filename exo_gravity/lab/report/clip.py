# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""A recording -> a clip: a wearer whose arms move as they did, torques and limits, and a caption with time and step.

Everything is drawn in the trunk's axes, the arms from the parameters that the recording holds, and the wearer as a
dummy. A GIF has one palette for all frames, which keeps it small.
"""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console
from rich.progress import track

from exo_gravity.core.errors import DataError, ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.vocabulary import Source
from exo_gravity.lab.bag.content import Bag
from exo_gravity.lab.inputs.arms import recorded_of
from exo_gravity.lab.inputs.parameter_file import node_of
from exo_gravity.lab.report.table import shown
from exo_gravity.lab.source import of_all
from exo_gravity.lab.trial.recording import Recording
from exo_gravity.lab.view.scene import LINE, SPHERE, TEXT, ArmView, Shape, arm_shapes
from exo_gravity.lab.view.urdf import COLOURS as MATERIALS
from exo_gravity.lab.view.urdf import Described, described, joint_names, urdf

SIZE, GIF_SIZE = (640, 480), (480, 360)  # pixels
COLOURS, SAMPLES = 256, 12  # of a GIF, and the frames of which these are
LINE_HEIGHT = 0.042  # of the picture's height
INK, LEADER = (40, 44, 52), (150, 156, 164)
NO_TORQUE = 0.05  # Nm, below which a motor is off
STEPS = {"move": "the wearer moves the arm", "hold": "hands off", "push": "a push"}
MAX_SHAPES = 4000
AZIMUTH = {"left": 215.0, "right": 145.0}  # deg, of the camera: in front, on the arm's side


@dataclass(frozen=True)
class Camera:
    """From where the wearer is seen."""

    both_sides: float = 165.0  #: deg, azimuth if both arms are worn
    elevation: float = -8.0  #: deg
    distance: float = 1.75  #: m
    centre: float = 0.24  #: m below the shoulders, what the camera looks at
    field_of_view: float = 38.0  #: deg


CAMERA = Camera()


GEOMS = {LINE: mujoco.mjtGeom.mjGEOM_CAPSULE, SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE}
BODY, LIMB = (0.80, 0.76, 0.70, 1.0), (0.80, 0.70, 0.62, 0.3)  # the wearer, and the arms that are worn
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
LIMB_SIZE = 0.075  # m, the diameter of an arm
SKY = ((0.97, 0.98, 1.0), (0.80, 0.84, 0.89))  # above and below


def write_clip(bag: Bag, path: Path, step: float, frame_rate: int, console: Console) -> None:
    """Write a clip with a frame for every `step` s of a recording, `frame_rate` of them per second.

    Raises DataError if the recording does not describe its arms, or the clip cannot be drawn or written.
    """
    end = min(float(recording.time[-1]) for recording in bag.recordings)
    times = [step * n for n in range(int(end / step) + 1)]
    hidden = not console.is_terminal
    drawn = track(times, f"drawing {path.name}", console=console, transient=True, disable=hidden)
    is_gif = path.suffix.lower() == ".gif"
    try:
        with closing(Stage(bag, *(GIF_SIZE if is_gif else SIZE))) as stage:
            if is_gif:
                few = [np.asarray(stage.picture(time)) for time in times[:: 1 + len(times) // SAMPLES]]
                found = np.unique(np.reshape(few, (1, -1, 3)), axis=1)  # each once: a torque is drawn by few pixels
                palette = Image.fromarray(found).quantize(COLOURS)
                first, *others = (stage.picture(t).quantize(palette=palette, dither=Image.Dither.NONE) for t in drawn)
                duration = round(1000 / frame_rate)  # ms
                first.save(path, save_all=True, append_images=others, duration=duration, loop=0)
                return
            with iio.imopen(path, "w", plugin="pyav") as file:
                file.init_video_stream("libx264", fps=frame_rate)
                for time in drawn:
                    file.write_frame(np.asarray(stage.picture(time)))
    except ParameterError as error:
        raise DataError(f"{bag.path}: {error}") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error})") from None


class Stage:
    """Draws frames of `width` x `height` pixels. Raises DataError if OpenGL does not work here."""

    def __init__(self, bag: Bag, width: int, height: int) -> None:
        arms = [_description(bag, recording.name) for recording in bag.recordings]
        pairs = zip(arms, bag.recordings, strict=True)
        source = of_all(bag.source(recording.name) for recording in bag.recordings)
        self._stamp = "SIMULATED" if source is Source.SIMULATED else ""
        self._arms = [(arm, recording.in_order(arm.limits.joint_names)) for arm, recording in pairs]
        self._model = _model(arms, width, height)
        self._dummy = _dummy(arms)
        self._data = mujoco.MjData(self._model)
        names = [name for own in joint_names(arms) for name in own]
        self._at = [int(self._model.joint(name).qposadr[0]) for name in names]
        self._camera = mujoco.MjvCamera()
        self._camera.lookat[:] = np.mean([arm.base for arm in arms], axis=0) - (0.0, 0.0, CAMERA.centre)
        self._camera.azimuth = AZIMUTH[arms[0].side] if len(arms) == 1 else CAMERA.both_sides
        self._camera.elevation, self._camera.distance = CAMERA.elevation, CAMERA.distance
        try:
            self._renderer = mujoco.Renderer(self._model, height, width, max_geom=MAX_SHAPES)
        except Exception as error:  # EGL, GLX and OSMesa raise what they like
            raise DataError(f"OpenGL does not draw here ({type(error).__name__}: {error})") from None
        self.close = self._renderer.close

    def picture(self, time: float) -> Image.Image:
        """Return the picture of the recording at `time` s."""
        views = [_view(arm, recording, time) for arm, recording in self._arms]
        self._data.qpos[self._at] = [angle for view in views for angle in view.theta]
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        for view in views:
            worn = Shape("wearer", LINE, view.arm.pose(view.theta)[0][1:], LIMB_SIZE, LIMB)  # it shows through
            for shape in (*arm_shapes(view), worn):
                _add(self._renderer.scene, shape)
        for shape in self._dummy:
            _add(self._renderer.scene, shape)
        picture = Image.fromarray(self._renderer.render())
        height = LINE_HEIGHT * picture.height
        font, draw = ImageFont.load_default(height), ImageDraw.Draw(picture)
        draw.text((picture.width - height / 2, height / 2), self._stamp, INK, font, "ra")
        draw.text((height / 2, height / 2), f"{time:.1f} s  {_step(self._arms[0][1], time)}", INK, font)
        for view in views:
            self._label(draw, font, view)
        return picture

    def _label(self, draw: ImageDraw.ImageDraw, font: Any, view: ArmView) -> None:
        """Write the torque of each joint at the picture's edge on the arm's side of the trunk, with a line to it."""
        width, height = self._renderer.width, self._renderer.height
        places = [self._pixel(joint) for joint in view.arm.pose(view.theta)[0][:-1]]
        middle, _ = self._pixel(np.multiply(view.arm.base, (1.0, 0.0, 1.0)))
        is_left, below, line = places[0][0] < middle, 0.16 * height, 1.15 * LINE_HEIGHT * height
        names = view.arm.limits.joint_names
        step = min(2.4 * line, (height - below) / len(names))  # so that the labels of many joints fit, too
        for n, (name, effort, (x, y)) in enumerate(zip(names, view.effort, places, strict=True)):
            label = f"{name.removeprefix(f'{view.arm.side}_').replace('_', ' ')}\n{shown(effort, 2)} Nm"
            top = min(max(below, y - line), height - step * (len(names) - n))
            below = top + step
            at, anchor = ((line / 2, top), "la") if is_left else ((width - line / 2, top), "ra")
            draw.multiline_text(at, label, INK, font, anchor, align="left" if is_left else "right")
            start, _, end, _ = draw.multiline_textbbox(at, label, font, anchor)
            draw.line(((end + 4 if is_left else start - 4, top + line), (x, y)), LEADER)

    def _pixel(self, point: np.ndarray) -> tuple[float, float]:
        """Return where a point (3,) is in the picture, from the left and from above."""
        left, right = self._renderer.scene.camera
        forward, up, away = np.array(left.forward), np.array(left.up), point - np.add(left.pos, right.pos) / 2
        scale = self._renderer.height / 2 / np.tan(np.radians(CAMERA.field_of_view) / 2) / (away @ forward)
        across = away @ np.cross(forward, up) * scale
        return self._renderer.width / 2 + across, self._renderer.height / 2 - away @ up * scale


def _dummy(arms: Sequence[Described]) -> list[Shape]:
    """Return the wearer without the arms that are worn."""
    middle = np.mean([arm.base for arm in arms], axis=0) * (1.0, 0.0, 1.0)
    worn = {1.0 if arm.side == "left" else -1.0 for arm in arms}
    parts = [(ends, size, {1.0, -1.0} if ends[0][1] else {1.0}) for *ends, size in DUMMY]
    parts += [(list(ends), LIMB_SIZE, {1.0, -1.0} - worn) for ends in pairwise(FREE_ARM)]
    return [
        Shape("wearer", LINE, middle + np.multiply(ends, (1.0, side, 1.0)), size, BODY)
        for ends, size, sides in parts
        for side in sides
    ]


def _view(arm: Described, recording: Recording, time: float) -> ArmView:
    """Return what is known of an arm at `time` s."""
    at = min(int(np.searchsorted(recording.time, time)), len(recording.time) - 1)
    rows = (recording.position, recording.velocity, recording.effort)
    theta, velocity, effort = (np.nan_to_num(row[at].astype(float)).tolist() for row in rows)
    powered = State.LETTING_DOWN if max(map(abs, effort)) > NO_TORQUE else State.DISABLED
    state = State.ACTIVE if _is_carried(recording, time) else powered
    return ArmView(arm, theta, velocity, effort, state.value)


def _is_carried(recording: Recording, time: float) -> bool:
    return any(start <= time <= end for start, end in recording.while_carried(-np.inf, np.inf))


def _step(recording: Recording, time: float) -> str:
    """Return what the script does at `time` s."""
    for step in recording.steps:
        if step.start <= time < step.end:
            return STEPS.get(step.action, step.action)
    if _is_carried(recording, time):
        return "carried"
    return "let down" if recording.carried and time > recording.carried[0][0] else "start-up checks"


def _description(bag: Bag, name: str) -> Described:
    """Return the arm `name` from the nodes' parameters in a recording. Raises DataError or ParameterError."""
    values = {executable: recorded_of(bag.parameters, name, executable) for executable in ("compensator", "can_bridge")}
    for executable, given in values.items():
        if not given:
            node = node_of(name, executable)
            raise DataError(f"{name}: the recording has no parameters of {node}, which describe the arm")
    return described(**values)


def _model(arms: Sequence[Described], width: int, height: int) -> Any:
    """Return the description as a MuJoCo model, with its visuals, light and a sky."""
    seen = '<mujoco><compiler discardvisual="false" fusestatic="false"/></mujoco></robot>'
    spec = mujoco.MjSpec.from_string(urdf(arms).replace("</robot>", seen))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.global_.fovy = CAMERA.field_of_view
    spec.visual.quality.offsamples, spec.visual.quality.numslices, spec.visual.quality.numstacks = 2, 16, 8
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.45,) * 3, (0.35,) * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=SKY[0], rgb2=SKY[1], width=256, height=1536,
    )  # fmt: skip
    spec.worldbody.add_light(pos=(1.5, -1.0, 2.0), dir=(-1.5, 1.0, -2.0), diffuse=(0.5,) * 3, castshadow=False)
    for geom in spec.geoms:
        if np.allclose(geom.rgba, MATERIALS["person"]):  # the dummy stands in its place
            geom.rgba = np.zeros(4)
    return spec.compile()


def _add(scene: Any, shape: Shape) -> None:
    """Add a shape to MuJoCo's scene; a text is drawn on the picture instead."""
    if shape.kind == TEXT:
        return
    kind, radius, colour = GEOMS[shape.kind], shape.size / 2, np.array(shape.colour, np.float32)
    for start, *end in [shape.points] if shape.kind == SPHERE else pairwise(shape.points):
        geom = scene.geoms[scene.ngeom]
        scene.ngeom += 1
        mujoco.mjv_initGeom(geom, kind, np.full(3, radius), start, np.eye(3).ravel(), colour)
        if end:
            mujoco.mjv_connector(geom, kind, radius, start, *end)
