"""Camera in a Mitsuba scene drawn by MuJoCo's renderer."""

from __future__ import annotations

import atexit
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np

from mi_nerfattack.deploy.built_in import BuiltInObject
from mi_nerfattack.deploy.environment import CameraFrame
from mi_nerfattack.deploy.mujoco.light import SHADOW_RADIUS, SUN_DISTANCE
from mi_nerfattack.deploy.mujoco.module import mujoco
from mi_nerfattack.deploy.mujoco.opengl import make_context
from mi_nerfattack.deploy.mujoco.spec import NEAR_M, map_spec
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.conventions import opencv_to_opengl
from mi_nerfattack.render.camera.intrinsics import Camera, ray_lengths

_SKY = 0.69  # of the far plane: what MuJoCo draws as the sky is a little farther
# Samples of a pixel. MuJoCo's textures are filtered alike in both directions, by the
# worse one: with square samples the marks on a road seen flat would blur away.
_ACROSS, _DOWN = 2, 4


class MujocoView(AbstractView):
    """Camera at any pose in a scene's meshes, rasterised with one light and shadows.

    Colours are those of the scene's textures in its sun and skylight; there are no
    reflections and no light from other surfaces. Frames do not depend on the seed.

    Args:
        scene: `mi.Scene`, metric, z up; meshes and rectangles of opaque materials.
        camera: without distortion.
        built_in: objects with geometry besides the scene's.
        exposure_ev: the scene's light is multiplied by two to this power.

    Raises:
        InputError: a camera with distortion, a scene that MuJoCo cannot draw, or no
            OpenGL without a window.
    """

    def __init__(
        self,
        scene: Any,
        camera: Camera,
        built_in: Sequence[BuiltInObject] = (),
        exposure_ev: float = 0.0,
    ) -> None:
        if camera.is_distorted:
            raise InputError(
                f"camera: distortion {camera.distortion}; MuJoCo draws pinhole images "
                "only: take one without distortion, or the environment 'mujoco'"
            )
        self.camera = camera
        spec = map_spec(scene, built_in, exposure_ev)
        buffer = spec.visual.global_
        buffer.offwidth = _ACROSS * camera.width
        buffer.offheight = _DOWN * camera.height
        self._window = _Window(spec.compile(), camera)
        self._lengths = ray_lengths(camera)
        self.show(())

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        """Render one frame; see :meth:`AbstractView.render`."""
        del seed
        pose = np.array(camera_to_world, np.float64)
        image, depth = self._window.draw(pose)
        along = (depth * self._lengths).astype(np.float32)
        along[along > _SKY * self._window.far] = np.inf
        return self._paster.paste(CameraFrame(image, along, pose))

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._window.close()


class _Window:
    """An invisible window onto a model: context, buffers, scene."""

    def __init__(self, model: mujoco.MjModel, camera: Camera) -> None:
        self._model, self._camera = model, camera
        self._gl: Any = make_context(camera.width, camera.height)
        self._context = self._make_context()
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._coarse = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._fine = mujoco.MjrRect(0, 0, _ACROSS * camera.width, _DOWN * camera.height)
        self.near = np.float32(NEAR_M)
        self.far = np.float32(model.vis.map.zfar * model.stat.extent)
        self._scene = self._make_scene()
        # before the display goes, which OpenGL ends at exit as well
        reference: weakref.ReferenceType[_Window] = weakref.ref(self)
        self._at_exit = lambda: _close(reference)
        atexit.register(self._at_exit)

    def draw(self, camera_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the image (h, w, 3) and the depth (h, w) along the axis, metres."""
        if self._gl is None:
            raise InputError("view: render comes before close")
        self._place(camera_to_world)
        self._gl.make_current()
        height, width = self._camera.height, self._camera.width
        fine = np.empty((_DOWN * height, _ACROSS * width, 3), np.uint8)
        mujoco.mjr_render(self._fine, self._scene, self._context)
        mujoco.mjr_readPixels(fine, None, self._fine, self._context)
        blocks = fine.reshape(height, _DOWN, width, _ACROSS, 3)
        image = blocks.mean(axis=(1, 3), dtype=np.float32).round().astype(np.uint8)
        buffer = np.empty((height, width), np.float32)
        flat = mujoco.mjtRndFlag.mjRND_SEGMENT
        self._scene.flags[flat] = True
        mujoco.mjr_render(self._coarse, self._scene, self._context)
        self._scene.flags[flat] = False
        mujoco.mjr_readPixels(None, buffer, self._coarse, self._context)
        near, far = float(self.near), float(self.far)
        # reversed: 1 at the near plane, 0 at the far one
        depth = near * far / (near + buffer.astype(np.float64) * (far - near))
        return np.ascontiguousarray(image[::-1]), depth[::-1]

    def close(self) -> None:
        """Free the buffers and the context; again does nothing."""
        if self._gl is None:
            return
        atexit.unregister(self._at_exit)
        self._gl.make_current()
        self._context.free()
        self._gl.free()
        self._gl = None

    def __del__(self) -> None:
        if getattr(self, "_at_exit", None) is not None:
            self.close()

    def _make_context(self) -> Any:
        try:
            scale = mujoco.mjtFontScale.mjFONTSCALE_100.value
            return mujoco.MjrContext(self._model, scale)
        except mujoco.FatalError as error:
            self._gl.free()
            raise InputError(
                f"camera: {self._camera.width} x {self._camera.height} px, of "
                f"{_ACROSS} x {_DOWN} samples each, are more than OpenGL draws here "
                f"({error}); take a smaller image, or the environment 'mujoco'"
            ) from error

    def _make_scene(self) -> mujoco.MjvScene:
        data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, data)
        scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 10)
        option, free = mujoco.MjvOption(), mujoco.MjvCamera()
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, option, None, free, everything, scene)
        scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        return scene

    def _place(self, camera_to_world: np.ndarray) -> None:
        """Move the camera, and the region in which the sun casts shadows."""
        matrix, camera = opencv_to_opengl(camera_to_world), self._camera
        scale_x, scale_y = self.near / camera.fx, self.near / camera.fy
        for eye in self._scene.camera:
            eye.pos, eye.up, eye.forward = matrix[:3, 3], matrix[:3, 1], -matrix[:3, 2]
            eye.frustum_near, eye.frustum_far = self.near, self.far
            eye.frustum_center = (0.5 * camera.width - camera.cx) * scale_x
            eye.frustum_width = 0.5 * camera.width * scale_x
            eye.frustum_bottom = (camera.cy - camera.height) * scale_y
            eye.frustum_top = camera.cy * scale_y
        ahead = matrix[:2, 3] - 0.5 * SHADOW_RADIUS * matrix[:2, 2]
        for light in self._scene.lights[: self._scene.nlight]:
            if not light.headlight:
                light.pos = np.append(ahead, 0) - SUN_DISTANCE * light.dir


def _close(reference: weakref.ReferenceType[_Window]) -> None:
    window = reference()
    if window is not None:
        window.close()
