"""Off-screen rendering of MuJoCo on a machine without a display."""

import ctypes.util
import logging
import os
import sys

_logger = logging.getLogger(__name__)


def has_display() -> bool:
    """Whether windows can open; on systems other than Linux it is taken for granted."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform != "linux" or any(os.environ.get(name) for name in names)


def can_draw() -> bool:
    """Whether images can be made here, as far as can be told without trying."""
    return has_display() or _offscreen_backend() is not None


def _offscreen_backend() -> str | None:
    backends = (("egl", "EGL"), ("osmesa", "OSMesa"))
    return next((name for name, library in backends if ctypes.util.find_library(library)), None)


def choose_headless_backend() -> None:
    """On a Linux machine without a display, let MuJoCo, before its import, render through EGL or
    OSMesa, unless the user chose already: Gymnasium would try a window. Refuses if there is
    neither.
    """
    if has_display() or "MUJOCO_GL" in os.environ:
        return
    backend = _offscreen_backend()
    if backend is None:
        raise RuntimeError(
            "rendering without a display needs libEGL or libOSMesa: install libegl1 or libosmesa6"
        )
    os.environ["MUJOCO_GL"] = backend
    _logger.info("no display: rendering with MUJOCO_GL=%s", backend)


def release_graphics() -> None:
    """Let go of the EGL context that this thread rendered with last, for use in another thread."""
    egl = sys.modules.get("mujoco.egl")
    if egl is None or egl.EGL_DISPLAY is None:
        return
    from OpenGL import EGL

    EGL.eglMakeCurrent(egl.EGL_DISPLAY, EGL.EGL_NO_SURFACE, EGL.EGL_NO_SURFACE, EGL.EGL_NO_CONTEXT)
