"""Films of episodes for people who compare them: one camera for all of them, where each began and
went, and several robots in one picture.
"""

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import mujoco
import numpy as np

from poem_envs.mujoco_rendering import StateRenderer, prepared_viewer

#: Of the first path, the second and so on, red, green and blue in [0, 1].
PATH_COLOURS = ((0.10, 0.33, 0.85), (0.90, 0.40, 0.02), (0.00, 0.52, 0.36), (0.62, 0.20, 0.65))
FLOOR_COLOUR, BANDS = (0.80, 0.82, 0.86), ((0.80, 0.82, 0.86), (0.90, 0.92, 0.95))
SKY, GREY, INK = (226, 231, 240), (0.45, 0.47, 0.52), (0.10, 0.12, 0.18)
# How much of their own colours is left to robots in a picture of several, and how solid they are.
OWN_COLOUR, SOLIDITY = 0.3, 0.85
# Field of view of the camera, degrees, and half the height that it sees at distance one.
FIELD_OF_VIEW, HALF_HEIGHT = 45.0, 0.4142
# Of half the picture, that stays free around paths, for robots that are drawn larger, and else.
MARGIN, LEAST_MARGIN = 0.48, 0.05
# In a picture of whole paths a robot is as large as in a film of its own, times this, or larger.
LEAST_SIZE = 0.68
TRAIL_PIECES, TRAIL_PIXELS = 16, 3.0
# Of the distance from the camera, at which ways in space are drawn: in front of what hides them.
IN_FRONT = 0.5
# Height of what is drawn on the floor, and between things that lie on each other there, m.
LAYER = 0.004
SLICES, MAX_SHAPES = 24, 2000
# To either side, m: seen from cameras over a hundred away its end is at the horizon. One without an
# end takes longer to draw.
FLOOR_SIZE, FARTHEST = 2000.0, 3000.0
# Distances between marks, m, of which a picture takes the first that gives it few enough.
MARK_DISTANCES, MOST_MARKS = (1, 2, 5, 10, 20, 50, 100), 8
# Size, position and orientation of a shape that gets others.
ANYWHERE = (np.ones(3), np.zeros(3), np.eye(3).ravel())
LINE, CYLINDER = mujoco.mjtGeom.mjGEOM_LINE, mujoco.mjtGeom.mjGEOM_CYLINDER
SPHERE, PLANE = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_PLANE
SKYBOX = mujoco.mjtTexture.mjTEXTURE_SKYBOX
PRIMITIVES = tuple(
    getattr(mujoco.mjtGeom, f"mjGEOM_{kind}") for kind in ("SPHERE", "CAPSULE", "CYLINDER", "BOX")
)
# At the edges of the picture, as its width and its height count from the lower left corner.
COMPASS = (("ahead", 0.5, 0.95), ("left", 0.07, 0.5), ("back", 0.5, 0.05), ("right", 0.92, 0.5))
#: Words, and where in space they stand, ``(3,)``.
Labels = list[tuple[str, np.ndarray]]


@dataclass(frozen=True)
class Look:
    """How a robot is filmed, so that it is seen what its tasks are about; degrees, metres."""

    azimuth: float = 90.0
    elevation: float = -20.0
    distance: float = 4.0
    #: In the middle of the picture; x and y from the robot's where the camera goes along with it
    lookat: tuple[float, float, float] = (0.0, 0.0, 0.5)
    #: What tells directions and distances: "metres" (lines across the x axis), "compass" (words,
    #: and circles around the start), "circles" (the same, at 1, 2 and 3 m), or nothing
    marks: str = ""
    #: The body whose way is drawn, or the site
    body: str | int = 1
    site: str | None = None
    #: Whether the camera goes along with the robot
    follows: bool = True
    #: Whether the way is drawn on the floor, or where the body was
    on_floor: bool = True
    #: Bodies that are no part of the task, and are not shown
    hidden: tuple[str, ...] = ()

    @property
    def ahead(self) -> np.ndarray:
        """The unit vector (3,) along the floor that points away from who looks."""
        turn = np.radians(self.azimuth)
        return np.array([np.cos(turn), np.sin(turn), 0.0])

    @property
    def right(self) -> np.ndarray:
        """The unit vector (3,) that points to the right in the picture."""
        return np.cross(self.ahead, (0.0, 0.0, 1.0))

    @property
    def up(self) -> np.ndarray:
        """The unit vector (3,) that points upwards in the picture."""
        tilt = np.radians(self.elevation)
        return np.array([0.0, 0.0, np.cos(tilt)]) - np.sin(tilt) * self.ahead

    @property
    def axes(self) -> np.ndarray:
        """To the right, upwards and away from who looks, (3, 3)."""
        return np.stack([self.right, self.up, np.cross(self.up, self.right)])


@runtime_checkable
class Filmed(Protocol):
    """An environment whose episodes can be filmed once they are over."""

    def film_state(self) -> np.ndarray:
        """What a picture of the present moment is drawn from, ``(state_dim,)``."""

    def film(
        self, paths: Sequence[np.ndarray], shown: Sequence[int], size: tuple[int, int]
    ) -> list[np.ndarray]:
        """Film episodes: images ``(height, width, 3)`` uint8, one a moment of the longest path,
        after whose end the shorter ones stand still.

        :param paths: Of each episode the states ``(moments, state_dim)``; all have a part in where
            the camera is
        :param shown: The numbers of those that are in the film, together in one scene
        :param size: Width and height, pixels
        """


def moments_of(paths: Sequence[np.ndarray]) -> list[list[int]]:
    """For every image of a film, which row of each path it shows."""
    longest = max(map(len, paths))
    return [[min(moment, len(path) - 1) for path in paths] for moment in range(longest)]


class MujocoFilms:
    """What makes an environment with a MuJoCo model :class:`Filmed`: a class before the family's
    own among the bases. A subclass defines ``_simulation``, and sets its ``look``.
    """

    #: How it is filmed.
    look = Look()
    _film_renderer: "FilmRenderer | None" = None

    def _simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """The model, and the data that the simulation is at."""
        raise NotImplementedError

    def film_state(self) -> np.ndarray:
        """See :class:`Filmed`: MuJoCo's ``mjSTATE_FULLPHYSICS``."""
        model, data = self._simulation()
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, state, spec)
        return state

    def film(
        self, paths: Sequence[np.ndarray], shown: Sequence[int], size: tuple[int, int]
    ) -> list[np.ndarray]:
        """See :class:`Filmed`."""
        model, renderer = self._film_model(), self._film_renderer
        if renderer is None or not renderer.fits(model, size):
            self._close_films()
            renderer = self._film_renderer = FilmRenderer(model, self.look, *size)
        return renderer.film(paths, shown)

    def _film_model(self) -> mujoco.MjModel:
        return self._simulation()[0]

    def _close_films(self) -> None:
        if self._film_renderer is not None:
            self._film_renderer.close()
            self._film_renderer = None


class FilmRenderer(StateRenderer):
    """Draws the states of several episodes of a MuJoCo model in one scene."""

    def __init__(self, model: mujoco.MjModel, look: Look, width: int, height: int) -> None:
        self.look, self._source = look, model
        own = copy.deepcopy(model)  # whose colours are changed
        super().__init__(own, width, height, fast=True, max_geom=MAX_SHAPES)
        own.vis.quality.numslices = SLICES
        self._others = mujoco.MjData(own)
        self._dress()
        self._viewer = viewer = prepared_viewer(self._renderer, "rgb_array", fast=True)
        self._camera, self._scene, self._viewport = viewer.cam, viewer.scn, viewer.viewport
        self._camera.azimuth, self._camera.elevation = look.azimuth, look.elevation
        self._axes = look.axes
        viewer.vopt.sitegroup[:] = 0
        looks_down = look.elevation <= -FIELD_OF_VIEW / 2
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = not looks_down
        mujoco.mjr_changeFont(mujoco.mjtFontScale.mjFONTSCALE_100, viewer.con)

    def fits(self, model: mujoco.MjModel, size: tuple[int, int]) -> bool:
        """Whether it draws this model in this size, width and height."""
        return model is self._source and size == (self._viewport.width, self._viewport.height)

    def film(self, paths: Sequence[np.ndarray], shown: Sequence[int]) -> list[np.ndarray]:
        """See :meth:`Filmed.film`."""
        # A placement moves bodies of the model.
        self._model.body_pos[:] = self._source.body_pos
        self._model.body_quat[:] = self._source.body_quat
        places = [self._places(path) for path in paths]
        moments, self._camera.distance = moments_of([paths[i] for i in shown]), self.look.distance
        self._camera.lookat[:] = self.look.lookat
        moves = self.look.follows and len(shown) == 1
        if not moves:
            self._frame(np.concatenate(places))
        self._viewer.make_context_current()  # another environment may have rendered since
        images = []
        for now in moments:
            if moves:
                here = places[shown[0]][now[0]]
                self._camera.lookat[:2] = here[:2] + self.look.lookat[:2]
            images.append(self._image(paths, places, dict(zip(shown, now, strict=True))))
        return images

    def _dress(self) -> None:
        """Give the floor a plain colour and no end, and let light come from the camera alone."""
        model, visual = self._model, self._model.vis
        model.light_active[:] = 0
        visual.headlight.ambient[:], visual.headlight.diffuse[:] = 0.65, 0.33
        visual.headlight.specular[:] = 0.1
        visual.global_.fovy = FIELD_OF_VIEW
        visual.map.znear, visual.map.zfar = 0.1 / model.stat.extent, FARTHEST / model.stat.extent
        for texture in np.flatnonzero(model.tex_type == SKYBOX):
            start, channels = model.tex_adr[texture], model.tex_nchannel[texture]
            pixels = model.tex_width[texture] * model.tex_height[texture]
            model.tex_data[start : start + pixels * channels].reshape(-1, channels)[:, :3] = SKY
        floors = model.geom_type == PLANE
        model.geom_matid[floors], model.geom_size[floors, :2] = -1, FLOOR_SIZE
        model.geom_rgba[floors] = (*FLOOR_COLOUR, 1.0)
        bodies = [model.body(name).id for name in self.look.hidden]
        # And those by which a hand is led.
        hidden = np.isin(model.geom_bodyid, bodies) | (model.body_mocapid[model.geom_bodyid] >= 0)
        model.geom_rgba[hidden, 3] = 0.0

    def _pose(self, data: mujoco.MjData, state: np.ndarray) -> np.ndarray:
        """Bring the data up to date for drawing; where the body is, ``(3,)``."""
        mujoco.mj_setState(self._model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_camlight(self._model, data)
        site = self.look.site
        place = data.body(self.look.body) if site is None else data.site(site)
        return np.array(place.xpos)

    def _places(self, path: np.ndarray) -> np.ndarray:
        places = np.stack([self._pose(self._data, state) for state in path])
        if self.look.on_floor:
            places[:, 2] = LAYER
        return places

    def _frame(self, places: np.ndarray) -> None:
        """Let the camera see places ``(n, 3)``, all at once, and nothing larger than usually."""
        look, camera = self.look, self._camera
        if look.follows:
            camera.lookat[:2] = (places.min(axis=0) + places.max(axis=0))[:2] / 2
        aside, upwards, beyond = self._axes @ (places - camera.lookat).T
        half = HALF_HEIGHT * (1 - (MARGIN if look.follows else LEAST_MARGIN))
        aspect = self._viewport.width / self._viewport.height
        needed = np.maximum(np.abs(aside) / (half * aspect), np.abs(upwards) / half) - beyond
        camera.distance = max(look.distance, needed.max())
        if look.follows:  # there is room for heads above the ways
            camera.lookat[2] *= (camera.distance / look.distance + 1) / 2

    def _image(
        self, paths: Sequence[np.ndarray], places: list[np.ndarray], shown: dict[int, int]
    ) -> np.ndarray:
        model, scene, viewport, viewer = self._model, self._scene, self._viewport, self._viewer
        for order, (i, now) in enumerate(shown.items()):
            data, first = (self._others, scene.ngeom) if order else (self._data, 0)
            self._pose(data, paths[i][now])
            if order == 0:
                drawn = viewer.vopt, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL
                mujoco.mjv_updateScene(model, data, *drawn, scene)
            else:
                moving = mujoco.mjtCatBit.mjCAT_DYNAMIC
                mujoco.mjv_addGeoms(model, data, viewer.vopt, viewer.pert, moving, scene)
            growth = 1.0
            if len(shown) > 1 and self.look.follows:
                away = (places[i][now] - self._eye()) @ self._axes[2]
                growth = max(growth, LEAST_SIZE * away / self.look.distance)
            # Those who run along a line have lanes.
            lane = np.array([0.0, 1.2 * growth * order, 0.0]) * (self.look.marks == "metres")
            if len(shown) > 1:
                self._recolour(first, PATH_COLOURS[i], places[i][now], growth, lane)
            self._add_way(places[i][: now + 1] + lane, PATH_COLOURS[i])
        start = places[next(iter(shown))][0]
        labels = self._add_marks(start)
        mujoco.mjr_render(viewport, scene, viewer.con)
        for text, x, y in labels:
            self._write(text, x, y)
        pixels = np.empty((viewport.height, viewport.width, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(pixels, None, viewport, viewer.con)
        return pixels[::-1]

    def _recolour(
        self,
        first: int,
        colour: Sequence[float],
        place: np.ndarray,
        growth: float,
        lane: np.ndarray,
    ) -> None:
        """Tint a robot, the shapes from the first on, and let it grow, in a lane of its own."""
        for shape in self._scene.geoms[first : self._scene.ngeom]:
            if shape.category != mujoco.mjtCatBit.mjCAT_DYNAMIC:
                continue
            shape.matid = -1
            shape.rgba[:3] = OWN_COLOUR * shape.rgba[:3] + (1 - OWN_COLOUR) * np.array(colour)
            shape.rgba[3] *= SOLIDITY
            if growth > 1.0 and shape.type in PRIMITIVES:
                shape.pos[:] = place + growth * (shape.pos - place)
                shape.size[:] *= growth
            shape.pos[:] += lane

    def _add_way(self, places: np.ndarray, colour: Sequence[float]) -> None:
        """A line along places ``(moments, 3)``, and a dot where it begins."""
        step, radius = max(1, len(places) // TRAIL_PIECES), 0.012 * self._camera.distance
        if self.look.on_floor:
            drawn = places + np.array([0.0, 0.0, 2 * LAYER])
            begin, size = CYLINDER, np.array([radius, LAYER / 4, 0.0])
        else:
            eye = self._eye()
            drawn = eye + IN_FRONT * (places - eye)
            begin, size = SPHERE, np.full(3, IN_FRONT * radius)
        self._add_lines(np.concatenate([drawn[:-1:step], drawn[-1:]]), colour, TRAIL_PIXELS)
        self._add_shape(begin, drawn[0], size, colour)

    def _add_marks(self, start: np.ndarray) -> list[tuple[str, float, float]]:
        """What tells distances and directions; the words, and where they are in the picture."""
        marks, camera = self.look.marks, self._camera
        if not marks:
            return []
        aspect = self._viewport.width / self._viewport.height
        width = 2 * HALF_HEIGHT * camera.distance * aspect
        apart = next((far for far in MARK_DISTANCES if width / far <= MOST_MARKS), 100)
        add = self._add_metres if marks == "metres" else self._add_circles
        labels = add(start, width, apart)
        away = np.array([place for _, place in labels]).reshape(-1, 3) - self._eye()
        aside, upwards, beyond = self._axes @ away.T
        depth = np.maximum(beyond, 1e-6)
        x = (1 + aside / depth / HALF_HEIGHT / aspect) / 2
        y = (1 + upwards / depth / HALF_HEIGHT) / 2
        inside = (depth > 1e-3) & (np.abs(x - 0.5) < 0.4) & (np.abs(y - 0.5) < 0.42)
        seen = [(labels[i][0], x[i], y[i]) for i in np.flatnonzero(inside)]
        return seen + (list(COMPASS) if marks != "metres" else [])

    def _add_metres(self, start: np.ndarray, width: float, apart: int) -> Labels:
        """Lines across the x axis."""
        x, y = self._camera.lookat[:2]
        near, far, reach = y - 0.3 * width, y + 0.6 * width, MOST_MARKS // 2 + 2
        middle, labels = round((x - start[0]) / apart), []
        for number in range(middle - reach, middle + reach + 1):
            x = start[0] + apart * number
            ends = np.array([[x, near, LAYER], [x, far, LAYER]])
            self._add_lines(ends, GREY, 2.0 if number % 5 == 0 else 1.0)
            labels.append((f"{apart * number} m", np.array([x, 0.6 * near + 0.4 * y, LAYER])))
        return labels

    def _add_circles(self, start: np.ndarray, width: float, apart: int) -> Labels:
        """Circles around the start."""
        look, way = self.look, (self._camera.lookat - start) * (1, 1, 0)
        away = float(np.linalg.norm(way))
        if look.marks == "circles":
            apart, first, last, beside = 1, 1, 3, look.right - look.ahead
        else:
            # Beside the way, where the camera is.
            apart, beside = max(apart, 2), way + 0.15 * width * (look.right - 0.5 * look.ahead)
            first, last = (
                1 + int(max(away + side, 0.0) // apart) for side in (-0.7 * width, 0.7 * width)
            )
        labels = []
        # Discs upon discs, the uppermost first: what is under them need not be drawn.
        for number in range(first, last + 1):
            height = LAYER * (last - number + 1) / last
            place = np.array([start[0], start[1], height])
            size = np.array([apart * number, height / 4, 0.0])
            self._add_shape(CYLINDER, place, size, BANDS[number % 2])
            there = place + apart * number / np.linalg.norm(beside) * beside
            if apart * number <= away + 0.35 * width:  # beyond they lie on each other
                labels.append((f"{apart * number} m", there))
        return labels

    def _eye(self) -> np.ndarray:
        """Where the camera is, ``(3,)``."""
        return self._camera.lookat - self._camera.distance * self._axes[2]

    def _write(self, text: str, x: float, y: float) -> None:
        """Write a word around a point of the picture."""
        font, resources = mujoco.mjtFont.mjFONT_NORMAL, self._viewer.con
        width = sum(resources.charWidth[ord(letter)] for letter in text)
        x -= width / 2 / self._viewport.width
        y -= resources.charHeight / 4 / self._viewport.height
        mujoco.mjr_text(font, text, resources, x, y, *INK)

    def _add_lines(self, corners: np.ndarray, colour: Sequence[float], width: float) -> None:
        scene, rgba = self._scene, np.array([*colour, 1.0], np.float32)
        for start, end in itertools.pairwise(corners):
            shape = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(shape, LINE, *ANYWHERE, rgba)
            mujoco.mjv_connector(shape, LINE, width, start, end)
            scene.ngeom += 1

    def _add_shape(
        self, kind: int, place: np.ndarray, size: np.ndarray, colour: Sequence[float]
    ) -> None:
        shape, upright = self._scene.geoms[self._scene.ngeom], np.eye(3).ravel()
        mujoco.mjv_initGeom(shape, kind, size, place, upright, np.array([*colour, 1.0], np.float32))
        self._scene.ngeom += 1
