"""The web page: a viser server that shows one row of a view at a time, and the controls that choose it."""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Any

import numpy as np

from xreset.pictures.meshes import GOAL_COLOR, OBJECT_COLOR, Color, rgb
from xreset.pictures.view.colors import HUMAN_COLOR, REACHED_COLOR, TOUCH_COLOR, reason_color
from xreset.pictures.view.data import BONES, GOOD, View
from xreset.pictures.view.server import IDLE, RobotMeshes, WebPage, as_html, bounded, chosen

_ALL = "all"


class Page(WebPage):
    """A page at :attr:`url` until :meth:`close`. All visitors see, and move, the same controls."""

    def __init__(
        self,
        view: View,
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        sequence: int | None = None,
        frame: int | None = None,
    ) -> None:
        """Start the server.

        Args:
            host: address to listen at; 0.0.0.0 for every address of the machine.
            port: port to listen at; the next free one if it is taken.
            sequence: first sequence to show; None: all of a bank, the first of another file.
            frame: first row to show, within the sequence; None: the first one with a hand.

        Raises:
            XResetError: viser is not installed, the server does not start, or the sequence or frame is unknown.
        """
        self.view = view
        if sequence is None and view.is_motion:
            sequence = 0
        self._rows = view.some_rows(sequence, frame)
        if frame is None:
            frame = int(np.argmax(view.has_hand[self._rows]))
        self._lock = threading.RLock()
        super().__init__(host, port, "xreset view")
        self._scene = _Scene(view, self._server)
        self._make_controls(sequence)
        self._frame.value = frame
        self.show()

    @property
    def row(self) -> int | None:
        """The row that is shown; None if no row meets the controls."""
        if not len(self._rows):
            return None
        return int(self._rows[min(bounded(self._frame), len(self._rows) - 1)])

    def show(self) -> None:
        """Update the scene and the text from the controls."""
        with self._lock, self._server.atomic():
            row = self.row
            if row is None:
                self._text.content = as_html("nothing meets this choice")
                return
            self._scene.show(row)
            number = min(bounded(self._frame) + 1, len(self._rows))
            position = f"{number} of {len(self._rows)}"
            self._text.content = as_html(*self.view.text(row), position)

    def tick(self) -> None:
        """Show the next frame while the play button is on."""
        if self._play.value and len(self._rows) > 1:
            time.sleep(1.0 / (self.view.rate * bounded(self._speed)))
            self._step(1)
        else:
            time.sleep(IDLE)

    def _make_controls(self, sequence: int | None) -> None:
        gui: Any = self._server.gui
        view = self.view
        self._reasons = {}
        for reason, count in Counter(view.reason).most_common():
            self._reasons[f"{reason or GOOD[view.kind]} ({count})"] = reason
        names = [f"{number}: {name}" for number, name in enumerate(view.sequence_name)]
        first = _ALL if sequence is None else names[sequence]
        self._sequence = gui.add_dropdown("sequence", [_ALL, *names], initial_value=first)
        self._reason = gui.add_dropdown("state", [_ALL, *self._reasons], visible=any(view.reason))
        label = "frame" if view.is_motion else "number"
        self._frame = gui.add_slider(label, 0, _slider_end(self._rows), 1, 0)
        gui.add_button("previous").on_click(lambda _: self._step(-1))
        gui.add_button("next").on_click(lambda _: self._step(1))
        self._play = gui.add_checkbox("play", False)
        self._speed = gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0)
        self._text = gui.add_html("")
        legend = ["Green: the object at its goal."]
        if view.human_keypoints is not None:
            legend.append("Pink: the human hand; yellow where it touches.")
        if view.fingertips is not None:
            legend.append("Blue: the robot's fingertips.")
        gui.add_html(as_html("Colors", *legend))
        for control in (self._sequence, self._reason):
            control.on_update(lambda _: self._choose())
        self._frame.on_update(lambda _: self.show())

    def _choose(self) -> None:
        with self._lock:
            sequence = chosen(self._sequence, _ALL)
            reason = chosen(self._reason, _ALL)
            self._rows = self.view.choose(
                sequence=None if sequence == _ALL else int(sequence.partition(":")[0]),
                reason=self._reasons.get(reason),
            )
            self._frame.max = _slider_end(self._rows)
            self._frame.value = 0
            self.show()

    def _step(self, by: int) -> None:
        with self._lock:
            if len(self._rows):  # setting the slider calls show, as if the user had moved it
                self._frame.value = (bounded(self._frame) + by) % len(self._rows)


def _slider_end(rows: np.ndarray) -> int:
    return max(len(rows) - 1, 1)  # a slider needs some length


class _Scene:
    """The meshes and points on the page."""

    def __init__(self, view: View, server: Any) -> None:
        self._view = view
        scene = server.scene
        self._objects = []
        self._goals = []
        for spec in view.objects:
            mesh = (spec.vertices, spec.faces)
            body = scene.add_mesh_simple(f"/object/{spec.name}", *mesh, color=rgb(OBJECT_COLOR))
            goal = scene.add_mesh_simple(
                f"/goal/{spec.name}", *mesh, color=rgb(GOAL_COLOR), opacity=0.35, cast_shadow=False
            )
            self._objects.append(body)
            self._goals.append(goal)
        self._robot = None if view.robot is None else RobotMeshes(scene, view.robot)

        def add_points(name: str, color: Color, size: float) -> Any:
            nowhere = np.zeros((1, 3), dtype=np.float32)
            options = {"point_size": size, "point_shape": "circle", "precision": "float32"}
            return scene.add_point_cloud(name, nowhere, rgb(color), **options)

        self._keypoints = add_points("/human/keypoints", HUMAN_COLOR, 0.012)
        self._tips = add_points("/robot/fingertips", REACHED_COLOR, 0.008)
        no_bones = np.zeros((len(BONES), 2, 3), np.float32)
        self._bones = scene.add_line_segments(
            "/human/bones", no_bones, rgb(HUMAN_COLOR), thickness=0.003
        )

    def show(self, row: int) -> None:
        """Place everything as in a row."""
        view = self._view
        shown = int(view.object_index[row])
        for i, (body, goal) in enumerate(zip(self._objects, self._goals, strict=True)):
            body.visible = i == shown
            goal.visible = i == shown
        self._tips.visible = view.fingertips is not None
        self._show_human(row)
        sequence = view.sequence[row]
        self._objects[shown].position = view.object_pos[row]
        self._objects[shown].wxyz = view.object_quat[row]
        self._goals[shown].position = view.goal_pos[sequence]
        self._goals[shown].wxyz = view.goal_quat[sequence]
        if view.fingertips is not None:
            self._tips.points = view.fingertips[row].astype(np.float32)
        if self._robot is not None and view.joint_pos is not None:
            self._robot.place(view.joint_pos[row], reason_color(view.reason[row]))

    def _show_human(self, row: int) -> None:
        keypoints = self._view.human_keypoints
        touching = self._view.human_touching
        visible = keypoints is not None and np.isfinite(keypoints[row]).all()
        self._keypoints.visible = visible
        self._bones.visible = visible
        if keypoints is None or touching is None or not visible:
            return
        points = keypoints[row].astype(np.float32)
        colors = np.where(touching[row, :, None], rgb(TOUCH_COLOR), rgb(HUMAN_COLOR))
        self._keypoints.points = points
        self._keypoints.colors = colors.astype(np.uint8)
        self._bones.points = points[BONES]
