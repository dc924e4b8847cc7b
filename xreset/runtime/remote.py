"""The client of ``xreset serve``. It needs websockets."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from .contract import LiveError
from .controller import Controller
from .driver import Array, Reading

LIVE_SCHEMA = "xreset-live/1"
"""Schema of the messages of ``xreset serve``."""


class RemoteController(Controller):
    """A policy that ``xreset serve`` runs, perhaps on another computer. It needs websockets on this one."""

    def __init__(self, url: str, timeout: float = 0.5) -> None:
        """Connect.

        Args:
            url: address of the server, such as ``ws://127.0.0.1:8765``.
            timeout: longest time to wait for an answer [s].

        Raises:
            LiveError: no policy is served there, or the server has another version.
        """
        from websockets.sync.client import connect

        self._timeout = timeout
        self._has_failed = False
        try:
            self._socket = connect(url, open_timeout=5, max_size=None, compression=None)
        except Exception as error:
            raise LiveError(
                f"No policy is served at {url} ({error}). Start it: xreset serve POLICY"
            ) from error
        hello = self._receive()
        if hello.get("schema") != LIVE_SCHEMA:
            raise LiveError(
                f"{url} has schema {str(hello.get('schema'))[:60]!r}, this runtime reads {LIVE_SCHEMA!r}. "
                "Use the same version of xreset on both computers."
            )
        super().__init__(hello.get("contract", {}), source=url)

    def begin(
        self,
        object_points: Array,
        goal_pos: Array,
        goal_quat: Array,
        target: Array,
        center: Array | None = None,
    ) -> None:
        """Begin an episode of one robot; arguments as for :meth:`Controller.begin`, without the axis N."""
        self.target = np.atleast_2d(np.asarray(target, dtype=np.float32))
        values = {
            "points": object_points,
            "goal_pos": goal_pos,
            "goal_quat": goal_quat,
            "target": target,
            "center": center,
        }
        self._ask({"begin": _lists(values)})

    def set_goal(self, pos: Array, quat: Array) -> None:
        """Set the goal pose."""
        self._ask({"goal": _lists({"goal_pos": pos, "goal_quat": quat})})

    def step(self, reading: Reading) -> Array:
        """[1, J] new joint targets for a reading of one robot."""
        reading = reading.batched()
        values = {}
        for name in ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force"):
            rows = getattr(reading, name)
            values[name] = None if rows is None else rows[0]
        answer = self._ask({"step": _lists(values)})
        try:
            target = np.array([answer["target"]], dtype=np.float32)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LiveError("the server's answer holds no target") from error
        if target.shape != self.target.shape:
            raise LiveError(f"the server's target has shape {target.shape[1:]}")
        self.target = target
        return target

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def _ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a message.

        The first failure ends the connection, because an answer that comes late would be taken for the next one.
        """
        if self._has_failed:
            raise LiveError("the connection has failed before. Make a new RemoteController")
        self._has_failed = True
        try:
            self._socket.send(json.dumps(message))
        except Exception as error:
            raise LiveError("the server has gone") from error
        answer = self._receive()
        self._has_failed = False
        if "error" in answer:
            raise LiveError(answer["error"])
        return answer

    def _receive(self) -> dict[str, Any]:
        try:
            answer = json.loads(self._socket.recv(timeout=self._timeout))
        except TimeoutError as error:
            raise LiveError(f"the server has not answered for {self._timeout:g} s") from error
        except Exception as error:
            raise LiveError("the server has gone") from error
        if not isinstance(answer, dict):
            raise LiveError(f"the server's answer is a {type(answer).__name__}, expected an object")
        return answer


def _lists(values: dict[str, Any]) -> dict[str, Any]:
    """Return arrays as lists, for JSON, without entries that are None."""
    return {name: np.asarray(value).tolist() for name, value in values.items() if value is not None}
