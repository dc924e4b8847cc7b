"""The page of a session: what a visitor sees, drags and chooses. All visitors share one robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from math import degrees
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.errors import XResetError
from xreset.eval.play.record import draw_film, last_moments
from xreset.eval.play.session import RESTS, Session
from xreset.files.text import short_name
from xreset.physics.plugins import backend_names, robot_names
from xreset.pictures.meshes import GOAL_COLOR, OBJECT_COLOR, rgb
from xreset.pictures.view.server import (
    RobotMeshes,
    WebPage,
    as_html,
    bounded,
    chosen,
    serve_until_interrupted,
)
from xreset.policy.shipped import shipped_graphs, shipped_name

if TYPE_CHECKING:
    from xreset.eval.policy_spec import PolicySpec

HELP = "Drag the **green shape**, and the robot brings the object there. Pull at the object or the robot to disturb it."
PHONE_STYLE = """<style>@media (max-width: 36em) {
[style*="width: 20em"] {width: 100% !important} [style*="max-height: 60%"] {max-height: 42% !important}
}</style>"""
"""On a phone, the controls leave the upper half to the robot."""
FRAME = 1 / 30
"""Time between two pictures [s]."""
TEXT_FRAME = 0.25
"""Time between two updates of the text [s]."""
LOOK_AT = np.array((0.57, 0.3, 0.3))
"""Middle of what happens [m]."""
RIGHT = np.array((0.79, 0.61, 0.0))
"""Direction to the right, seen from the camera."""
NEAR = 1.05
"""Distance of the camera next to that of other pages."""
BEHIND = 0.2
"""A delay behind the clock from which the page does not try to catch up [s]."""
GROWTH = 1.03
"""Size of the goal next to the object, so that a pointer meets the goal first where both are in one place."""


def serve(policy: str | Path | PolicySpec | None, *, host: str, port: int, **options: Any) -> None:
    """Serve a live episode until Ctrl-C; ``options`` are those of :class:`~xreset.eval.play.session.Session`."""
    print("Loading the policy, the object and the engine ...", flush=True)
    session = Session(policy, **options)
    try:
        page = Page(session, host=host, port=port)
        print(f"{session.policy.name} plays at {page.url}. Ctrl-C ends.", flush=True)
        serve_until_interrupted(page)
    finally:
        session.close()


class Page(WebPage):
    """A page at :attr:`url` until :meth:`close`.

    The session is used by :meth:`serve` alone. What visitors do waits in a queue until the next control step.
    """

    def __init__(self, session: Session, *, host: str = "127.0.0.1", port: int = 8080) -> None:
        """Start the server.

        Args:
            session: what is played.
            host: address to listen at; 0.0.0.0 for every address of the machine.
            port: port to listen at; the next free one if it is taken.

        Raises:
            XResetError: viser is not installed, or the server does not start.
        """
        self.session = session
        super().__init__(host, port, "xreset play")
        self._queue: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._paused = False
        self._factor = 1.0
        """How many seconds are played in a second."""
        self._holder: int | None = None
        """The visitor who pulls or turns something."""
        self._turning = False
        self._drawn = self._written = self._due = 0.0
        self._clock = (time.monotonic(), session.time)
        self._films = ThreadPoolExecutor(1)
        self._things: list[Any] = []
        self._make_controls()
        self._make_scene()
        camera = self._server.initial_camera
        camera.position = NEAR * np.subtract(camera.position, LOOK_AT) + LOOK_AT
        camera.look_at = LOOK_AT
        self._server.on_client_disconnect(self._on_disconnect)
        self._draw()

    def tick(self) -> None:
        """Do what visitors have asked for, take a control step if one is due, and wait for the next one.

        While nobody looks, time stands still.
        """
        self._run_queue()
        now = time.monotonic()
        watched = bool(self._server.get_clients())
        if self._paused or not watched:
            self._clock = (now, self.session.time)
            self._due = now
            if watched:
                self._draw()
            time.sleep(FRAME)
            return
        self._step()
        if now - self._drawn > FRAME:
            self._draw()
        self._due = max(self._due + self.session.control_dt / bounded(self._speed), now - BEHIND)
        time.sleep(max(0.0, self._due - time.monotonic()))

    def close(self) -> None:
        """Stop the server. The session stays open."""
        self._films.shutdown(wait=False, cancel_futures=True)
        super().close()

    def _enqueue(self, action: Callable[..., Any], *arguments: Any) -> None:
        self._queue.put(lambda: action(*arguments))

    def _run_queue(self) -> None:
        while True:
            try:
                action = self._queue.get_nowait()
            except Empty:
                return
            try:
                action()
            except Exception as error:  # a visitor may send anything
                self._notify("That does not work", str(error))

    def _step(self) -> None:
        try:
            self.session.step()
        except XResetError as error:
            self._notify("Restarted", str(error))
        if self._retry.value and self.session.dropped:
            self._notify("Dropped", "The robot tries again from home.")
            self.session.begin(keep_goal=True)

    def _notify(self, title: str, text: str) -> None:
        for client in self._server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=8.0)

    @contextmanager
    def _loading(self) -> Iterator[None]:
        """Show that something is being loaded, and restore the controls from the session, whatever happened."""
        notes = []
        for client in self._server.get_clients().values():
            notes.append(
                client.add_notification("Loading", "", loading=True, with_close_button=False)
            )
        try:
            yield
        finally:
            for note in notes:
                note.remove()
            self._show_choices()

    # Visitors ---------------------------------------------------------------------------------------------------------

    def _on_disconnect(self, client: Any) -> None:
        if self._holder == client.client_id:
            self._turning = False
            self._enqueue(self.session.release)

    # The scene --------------------------------------------------------------------------------------------------------

    def _make_scene(self) -> None:
        """Show robot, object and goal of the session in place of earlier ones."""
        for drawn in self._things:
            drawn.remove()
        session = self.session
        scene = self._server.scene
        obj = session.scene.objects[0]
        radius = float(np.ptp(obj.vertices, axis=0).max()) / 2
        middle = (obj.vertices.max(axis=0) + obj.vertices.min(axis=0)) / 2
        self._body = scene.add_mesh_simple(
            "/object", obj.vertices, obj.faces, color=rgb(OBJECT_COLOR)
        )
        # Rings turn the goal. The shape or, where a hand hides it, the ball next to it is dragged.
        self._rings = scene.add_transform_controls(
            "/rings",
            scale=2.4 * radius,
            disable_axes=True,
            disable_sliders=True,
            depth_test=False,
            line_width=3.5,
        )
        self._goal = scene.add_mesh_simple(
            "/goal",
            middle + GROWTH * (obj.vertices - middle),
            obj.faces,
            color=rgb(GOAL_COLOR),
            opacity=0.4,
            cast_shadow=False,
        )
        self._handle = scene.add_icosphere("/handle", 0.018, rgb(GOAL_COLOR))
        self._hint = scene.add_label(
            "/handle/hint", "drag me", position=(0.0, 0.0, 0.02), anchor="bottom-center"
        )
        self._beside = 1.8 * radius * RIGHT
        self._robot = RobotMeshes(scene, session.policy.robot)
        links = self._robot.links
        self._things = [self._hint, self._handle, self._rings, self._goal, self._body]
        self._things += links.values()
        self._rings.on_update(self._turn)
        for part in (self._goal, self._handle):
            part.on_drag("left")(self._drag)
        self._pull_at(self._body, None)
        for name, link in links.items():
            self._pull_at(link, name)

    def _pull_at(self, mesh: Any, link: str | None) -> None:
        async def pull(event: Any) -> None:
            if event.phase == "start":
                self._holder = event.client_id
                self._enqueue(self.session.grab, link, event.start_position)
            self._enqueue(self.session.pull, event.end_position)
            if event.phase == "end":
                self._enqueue(self.session.release)

        mesh.on_drag("left")(pull)

    async def _drag(self, event: Any) -> None:
        if event.phase == "start":
            self._grasped = self._goal.position - np.array(event.start_position)
        self._enqueue(
            self._move_goal, np.array(event.end_position) + self._grasped, self._goal.wxyz.copy()
        )

    async def _turn(self, event: Any) -> None:
        self._holder = event.client_id
        self._turning = event.phase != "end"
        self._enqueue(self._move_goal, self._goal.position.copy(), event.target.wxyz.copy())

    def _move_goal(self, pos: np.ndarray, quat: np.ndarray) -> None:
        self._hint.visible = False
        self.session.move_goal(pos, quat)

    def _draw(self) -> None:
        """Show the present state."""
        session = self.session
        state = session.world.state
        with self._server.atomic():
            self._robot.place(state["joint_pos"])
            self._body.position = state["object_pos"]
            self._body.wxyz = state["object_quat"]
            self._body.visible = not session.away
            self._goal.position = session.goal_pos
            self._goal.wxyz = session.goal_quat
            self._handle.position = self._goal.position + self._beside
            if not self._turning:
                self._rings.position = self._goal.position
                self._rings.wxyz = self._goal.wxyz
        self._drawn = time.monotonic()
        if self._drawn - self._written > TEXT_FRAME:
            self._write()

    # The controls -----------------------------------------------------------------------------------------------------

    def _make_controls(self) -> None:
        gui: Any = self._server.gui
        gui.set_panel_label("xreset play")
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=rgb(GOAL_COLOR))
        gui.add_html(PHONE_STYLE)
        gui.add_markdown(HELP)
        self._text = gui.add_html("")
        self._run = gui.add_button_group("time", ("Pause", "Step", "Restart"))
        self._run.on_click(lambda _: self._enqueue(self._press, self._run.value))
        self._speed = gui.add_slider("speed", 0.1, 1.0, 0.1, 1.0)
        self._take = gui.add_button("Take the object away")
        self._take.on_click(lambda _: self._enqueue(self._toggle_object))
        self._retry = gui.add_checkbox(
            "try again", True, hint="Begin again from home once the object was dropped."
        )
        self._object = gui.add_dropdown("object", ("",))
        self._engine = gui.add_dropdown("engine", backend_names())
        self._opened = self.session.policy
        self._policies = {
            self._opened.name: self._opened,
            **{name: name for name in shipped_graphs()},
            RESTS: RESTS,
        }
        with gui.add_folder("robot and policy", expand_by_default=False):
            self._policy = gui.add_dropdown("policy", tuple(self._policies))
            names = dict.fromkeys((self.session.policy.robot.name, *robot_names()))
            self._robot_name = gui.add_dropdown("robot", tuple(names))
        with gui.add_folder("save", expand_by_default=False):
            self._seconds = gui.add_slider("seconds", 2, 60, 1, 10)
            film = gui.add_button("Film (mp4)")
            film.on_click(lambda event: self._enqueue(self._save_film, event.client))
        self._show_choices()
        for control in (self._object, self._engine, self._policy, self._robot_name):
            control.on_update(lambda _: self._enqueue(self._open_chosen))

    def _show_choices(self) -> None:
        """Let the controls say what the session is."""
        session = self.session
        self._names = {short_name(name): name for name in session.objects}
        self._object.options = tuple(self._names)
        self._object.value = short_name(session.object_name)
        self._engine.value = session.engine
        self._policy.value = session.policy.name
        self._robot_name.value = session.policy.robot.name

    def _press(self, button: str) -> None:
        if button == "Restart":
            self.session.begin()
        else:
            self._paused = button != "Go on"
            self._run.options = ("Go on" if self._paused else "Pause", "Step", "Restart")
        if button == "Step":
            self._step()

    def _toggle_object(self) -> None:
        if self.session.away or self.session.lost:
            self.session.begin(keep_goal=True)
        else:
            self.session.take_away()

    def _open_chosen(self) -> None:
        """Open what the controls say, unless it is open already."""
        session = self.session
        robot = chosen(self._robot_name, session.policy.robot.name)
        policy = chosen(self._policy, session.policy.name)
        engine = chosen(self._engine, session.engine)
        object_name = self._names.get(self._object.value, session.object_name)
        if robot != session.policy.robot.name:
            policy = self._usual_policy(robot)
        if (robot, policy) != (session.policy.robot.name, session.policy.name):
            choice = partial(
                session.choose_policy,
                self._policies[policy],
                robot=robot if policy == RESTS else None,
            )
        elif object_name != session.object_name:
            choice = partial(session.choose_object, object_name)
        elif engine != session.engine:
            choice = partial(session.choose_engine, engine)
        else:
            return
        with self._loading():
            choice()
            self._make_scene()

    def _usual_policy(self, robot: str) -> str:
        """Return the policy with which a robot begins: the one that was opened first, one that ships, or none."""
        if robot == self._opened.robot.name:
            return self._opened.name
        name = shipped_name(robot)
        return name if name in self._policies else RESTS

    def _write(self) -> None:
        """Show what the text and the buttons say."""
        session = self.session
        now = time.monotonic()
        wall = now - self._clock[0]
        if wall > 1.0:
            self._factor = (session.time - self._clock[1]) / wall
            self._clock = (now, session.time)
        self._take.label = (
            "Put the object back" if session.away or session.lost else "Take the object away"
        )
        self._written = now
        if session.history:
            self._text.content = as_html(*self._status())

    def _status(self) -> tuple[str, str]:
        """Return where the object is, and how fast the session plays."""
        session = self.session
        last = session.history[-1]
        if session.away:
            where = "The object is away."
        elif session.lost:
            where = "The object has left the table. Put it back."
        elif last.success:
            where = (
                f"At the goal: {100 * last.distance:.1f} cm, {degrees(last.angle):.0f} degrees off."
            )
        else:
            where = (
                f"{100 * last.distance:.1f} cm and {degrees(last.angle):.0f} degrees from the goal."
            )
        if self._paused:
            return where, f"{session.engine}, paused"
        reason = ", slowed by this machine" if self._factor < 0.9 * bounded(self._speed) else ""
        return where, f"{session.engine}: {self._factor:.2f} x real time{reason}"

    # Saving -----------------------------------------------------------------------------------------------------------

    def _save_film(self, client: Any) -> None:
        moments = last_moments(self.session, bounded(self._seconds))
        note = client.add_notification(
            "Drawing the film", "It takes a while. Go on playing.", loading=True
        )
        film = self._films.submit(draw_film, self.session.scene, moments)

        def send(done: Any) -> None:
            note.remove()
            if done.exception():
                client.add_notification("No film", str(done.exception()))
            else:
                client.send_file_download("play.mp4", done.result())

        film.add_done_callback(send)
