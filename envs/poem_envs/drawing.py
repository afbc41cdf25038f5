"""A few antialiased shapes on a numpy image, and a window to show it."""

from __future__ import annotations

import numpy as np

Colour = tuple[int, int, int]


class Canvas:
    """A white image, ``width`` by ``height`` pixels, onto which shapes are painted in coordinates
    of a plane (x right, y up), of which its shorter side shows ``extent`` around ``centre``.
    """

    def __init__(self, width: int, height: int, centre: tuple[float, float], extent: float) -> None:
        self._pixels = np.full((height, width, 3), 255.0)
        self._per_unit = min(width, height) / extent
        self._x = centre[0] + (np.arange(width) + 0.5 - width / 2) / self._per_unit
        self._y = centre[1] - (np.arange(height)[:, None] + 0.5 - height / 2) / self._per_unit

    def disc(self, x: float, y: float, radius: float, colour: Colour) -> None:
        """Paint a filled circle around a point."""
        reach = radius + 1.0 / self._per_unit  # beyond it no pixel is touched
        rows = _span(np.abs(self._y[:, 0] - y) <= reach)
        columns = _span(np.abs(self._x - x) <= reach)
        distance = np.hypot(self._x[columns] - x, self._y[rows] - y) - radius
        self._paint(distance, colour, self._pixels[rows, columns])

    def upper_half_circle(self, radius: float, line_width: float, colour: Colour) -> None:
        """Paint the line of the half-circle around the origin where y >= 0."""
        line = np.abs(np.hypot(self._x, self._y) - radius) - line_width / 2
        self._paint(np.maximum(line, -self._y), colour, self._pixels)

    def image(self) -> np.ndarray:
        """What was painted, ``(height, width, 3)`` uint8."""
        return np.rint(self._pixels).astype(np.uint8)

    def _paint(self, distance: np.ndarray, colour: Colour, window: np.ndarray) -> None:
        """Paint where the distance to a shape's edge, ``(rows, columns)``, is below zero."""
        coverage = np.clip(0.5 - distance * self._per_unit, 0.0, 1.0)
        touched = coverage > 0.0
        old = window[touched]
        window[touched] = old + coverage[touched][:, None] * (np.array(colour, np.float64) - old)


def _span(inside: np.ndarray) -> slice:
    """The slice from the first to the last that is inside."""
    places = np.flatnonzero(inside)
    return slice(places[0], places[-1] + 1) if len(places) else slice(0, 0)


class ImageWindow:
    """A window that shows images, through GLFW and OpenGL, which MuJoCo's package brings along."""

    def __init__(self, width: int, height: int, title: str) -> None:
        import glfw

        self._glfw, self._window = glfw, None
        if glfw.init():
            glfw.window_hint(glfw.RESIZABLE, glfw.FALSE)
            self._window = glfw.create_window(width, height, title, None, None)
        if not self._window:
            raise RuntimeError(
                "render_mode='human' could not open a window; use 'rgb_array' on a machine without "
                "a display"
            )

    def show(self, image: np.ndarray) -> None:
        """Show an image, ``(height, width, 3)`` uint8."""
        from OpenGL import GL

        glfw = self._glfw
        glfw.make_context_current(self._window)
        height, width, _ = image.shape
        # larger than the window on dense displays
        frame_width, frame_height = glfw.get_framebuffer_size(self._window)
        GL.glViewport(0, 0, frame_width, frame_height)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        GL.glRasterPos2f(-1.0, -1.0)
        GL.glPixelZoom(frame_width / width, frame_height / height)
        upright = np.ascontiguousarray(image[::-1])
        GL.glDrawPixels(width, height, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, upright)
        glfw.swap_buffers(self._window)
        glfw.poll_events()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._glfw.destroy_window(self._window)
            self._window = None
