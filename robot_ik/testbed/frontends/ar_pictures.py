"""Live augmented reality on the page: sends pictures and status, and applies the choices."""

from __future__ import annotations

import dataclasses
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from robot_ik.ports import Closing
from robot_ik.testbed.ar.setup import ArDelay, ArSetup
from robot_ik.testbed.commands import MoveGoal
from robot_ik.testbed.frontends import actions
from robot_ik.testbed.frontends.channel import Channel
from robot_ik.testbed.frontends.picture_message import NO_BALL, packed
from robot_ik.testbed.session import Session
from robot_ik.testbed.view import View

if TYPE_CHECKING:
    from robot_ik.testbed.ar.live import ArPicture, ArStatus, LiveAr

STATUS_PERIOD = 0.25
"""Seconds between two messages about rate, age and error of the pictures."""

_GRAB = 40.0
"""Pixels around the ball in which the mouse grabs it. The ball moves with a moving board."""


class ArPictures(Closing):
    """Sends the pictures to the page while they are switched on.

    Args:
        session: The session whose first robot is drawn.
        channel: Where pictures go.
    """

    def __init__(self, session: Session, channel: Channel) -> None:
        self._session = session
        self._channel = channel
        self._lock = threading.Lock()
        self._live: LiveAr | None = None
        self._view: View | None = None
        self._is_on = False
        self._writes = True
        self._place: actions.ArPlace = "whole"
        self._setup = ArSetup()
        self._delay = ArDelay()
        self._is_grabbed = False
        self._ball = NO_BALL
        self._status_due = 0.0
        self._problem = ""

    @property
    def is_on(self) -> bool:
        """Whether pictures are taken."""
        return self._is_on

    @property
    def live_status(self) -> ArStatus | None:
        """Status of the pictures. None before the first ones."""
        return None if self._live is None else self._live.status

    def switch(self, on: bool) -> None:
        """Take pictures, or none. What that needs is loaded on a thread, the first time."""
        with self._lock:
            self._is_on = on
            if self._live is not None:
                self._live.switch(on)
                return
        if on:
            threading.Thread(target=self._open, name="testbed-ar-opening", daemon=True).start()

    def _open(self) -> None:
        # Here: tracker and painter take a fifth of the start of the page.
        from robot_ik.testbed.ar.live import LiveAr

        with self._lock:
            if self._live is None and self._is_on:
                self._live = LiveAr(self._session, self._show, self._tell)
                self._live.writes = self._writes
                self._live.set_setup(self._setup)
                self._live.set_delay(self._delay)
                if self._view is not None:
                    self._live.show_view(self._view)
                self._live.switch(True)

    def write_captions(self, on: bool) -> None:
        """Write ball, mode and decision into the pictures, or nothing."""
        with self._lock:
            self._writes = on
            if self._live is not None:
                self._live.writes = on

    def show_view(self, view: View) -> None:
        """Take the view that is drawn from now on."""
        self._view = view
        if self._live is not None:
            self._live.show_view(view)

    def act(self, action: actions.Action) -> None:
        """Apply an action about augmented reality. Other actions are ignored."""
        with self._lock:
            match action:
                case actions.PlaceAr(place):
                    self._place = place
                case actions.SetArCamera(camera, intrinsics, board, dictionary):
                    self._setup = replace(
                        self._setup,
                        camera=camera.strip(),
                        intrinsics=intrinsics.strip(),
                        board=board.strip(),
                        dictionary=dictionary.strip(),
                    )
                case actions.SetArBall(ball, marker, size):
                    self._setup = replace(self._setup, ball=ball, marker=marker, marker_size=size)
                case actions.SetArDelay(seconds, sync, predict, shift):
                    self._delay = ArDelay(seconds, sync, predict, shift)
            if self._live is not None:
                self._live.set_setup(self._setup)
                self._live.set_delay(self._delay)

    def dragged(self, action: actions.DragArBall) -> MoveGoal | None:
        """Return the command that moves the ball, or None if the mouse has not grabbed it."""
        if action.begins:
            x, y, radius = self._ball
            self._is_grabbed = abs(complex(action.u - x, action.v - y)) < radius + _GRAB
        if self._live is None or not self._is_grabbed:
            return None
        position = self._live.ball_at(action.u, action.v)
        if position is None:
            return None
        x, y, z = (float(value) for value in position)
        return MoveGoal((x, y, z))

    def settings(self) -> dict[str, Any]:
        """Return the present choices."""
        return {
            "on": self._is_on,
            "place": self._place,
            **dataclasses.asdict(self._setup),
            **dataclasses.asdict(self._delay),
        }

    def close(self) -> None:
        """End the camera's thread."""
        with self._lock:
            self._is_on = False
            live = self._live
        if live is not None:
            live.close()

    # On the camera's thread

    def _show(self, picture: ArPicture) -> None:
        self._ball = picture.ball
        taken = time.time() - (time.monotonic() - picture.time)
        self._channel.send_picture(packed(picture.image, picture.number, taken, picture.ball))

    def _tell(self, status: ArStatus) -> None:
        now = time.monotonic()
        if now < self._status_due and status.on and status.problem == self._problem:
            return
        self._status_due = now + STATUS_PERIOD
        self._problem = status.problem
        self._channel.publish("ar", dataclasses.asdict(status))
