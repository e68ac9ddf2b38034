"""The arms of a robot description drawn by MuJoCo without a screen, with `core.view.scene` around them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from exo_gravity.core.errors import DataError
from exo_gravity.core.view.arm_description import ArmDescription
from exo_gravity.core.view.scene import ARROW, LINE, SPHERE, Shape
from exo_gravity.core.view.urdf import joint_names, urdf

MAX_SHAPES = 4000
AZIMUTH = {"left": 215.0, "right": 145.0}  # deg, of the camera: in front, on the arm's side
BOTH_SIDES, ELEVATION, DISTANCE = 165.0, -8.0, 1.75  # deg, deg, m
CENTRE = 0.28  # m below the shoulders, what the camera looks at
FIELD_OF_VIEW = 38.0  # deg
SKY = ((0.97, 0.98, 1.0), (0.80, 0.84, 0.89))  # above and below


class Stage:
    """Draws frames of `width` x `height` pixels. Raises DataError if OpenGL does not work here."""

    def __init__(self, arms: Sequence[ArmDescription], width: int, height: int) -> None:
        self._model = _model(arms, width, height)
        self._data = mujoco.MjData(self._model)
        names = [name for four in joint_names(arms) for name in four]
        self._at = [int(self._model.joint(name).qposadr[0]) for name in names]
        self._camera = _camera(arms)
        try:
            self._renderer = mujoco.Renderer(self._model, height, width, max_geom=MAX_SHAPES)
        except Exception as error:  # EGL, GLX and OSMesa raise what they like
            raise DataError(f"OpenGL does not draw here ({type(error).__name__}: {error})") from None

    def frame(self, angles: Iterable[float], shapes: Iterable[Shape]) -> np.ndarray:
        """Return the picture (height, width, 3) uint8 of the arms at `angles`, rad, four for each arm in order."""
        self._data.qpos[self._at] = list(angles)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        for shape in shapes:
            _add(self._renderer.scene, shape)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._renderer.close()


def _model(arms: Sequence[ArmDescription], width: int, height: int) -> Any:
    """Return the description as a MuJoCo model, with its visuals, light and a sky."""
    seen = '<mujoco><compiler discardvisual="false" fusestatic="false"/></mujoco></robot>'
    spec = mujoco.MjSpec.from_string(urdf(arms).replace("</robot>", seen))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.global_.fovy = FIELD_OF_VIEW
    spec.visual.quality.offsamples, spec.visual.quality.numslices, spec.visual.quality.numstacks = 2, 16, 8
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.45,) * 3, (0.35,) * 3
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=SKY[0], rgb2=SKY[1], width=256, height=1536,
    )  # fmt: skip
    spec.worldbody.add_light(pos=(1.5, -1.0, 2.0), dir=(-1.5, 1.0, -2.0), diffuse=(0.5,) * 3, castshadow=False)
    return spec.compile()


def _camera(arms: Sequence[ArmDescription]) -> Any:
    base = np.mean([arm.base for arm in arms], axis=0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = base - (0.0, 0.0, CENTRE)
    camera.azimuth = AZIMUTH[arms[0].side] if len(arms) == 1 else BOTH_SIDES
    camera.elevation, camera.distance = ELEVATION, DISTANCE
    return camera


def _add(scene: Any, shape: Shape) -> None:
    """Add a shape to MuJoCo's scene; a text is left out, since the caption carries the words."""
    radius = shape.size / 2
    if shape.kind == LINE:
        for start, end in zip(shape.points, shape.points[1:], strict=False):
            _connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, radius, start, end, shape.colour)
    elif shape.kind == ARROW:
        start, end = shape.points
        _connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, radius, start, end, shape.colour)
    elif shape.kind == SPHERE:
        size = np.full(3, radius)
        geom = _next(scene)
        mujoco.mjv_initGeom(
            geom,
            mujoco.mjtGeom.mjGEOM_SPHERE,
            size,
            shape.points[0],
            np.eye(3).ravel(),
            np.array(shape.colour, np.float32),
        )


def _connect(scene: Any, kind: Any, radius: float, start: np.ndarray, end: np.ndarray, colour: Sequence[float]) -> None:
    geom = _next(scene)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(colour, np.float32))
    mujoco.mjv_connector(geom, kind, radius, start, end)


def _next(scene: Any) -> Any:
    scene.ngeom += 1
    return scene.geoms[scene.ngeom - 1]
