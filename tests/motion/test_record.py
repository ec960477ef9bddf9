"""The recorder returns the vectors that were sent to it."""

from __future__ import annotations

import numpy as np
import pytest

from robot_ik.errors import TrajectoryError
from robot_ik.motion import RecorderSink
from robot_ik.ports import JointSink


def test_the_recorder_returns_the_sent_vectors_with_times_from_zero():
    sink = RecorderSink(["a", "b"])
    assert isinstance(sink, JointSink)
    q = np.zeros(2)
    for k in range(3):
        q[:] = k, -k
        sink.send(q, 10.0 + 0.5 * k)  # the same array each time: it must be copied
    path = sink.trajectory()
    assert path.times.tolist() == [0.0, 0.5, 1.0]
    assert path.q.tolist() == [[0, 0], [1, -1], [2, -2]] and path.joints == ("a", "b")


def test_a_second_command_for_one_time_replaces_the_first():
    sink = RecorderSink(["a"])
    for value in (1.0, 2.0):
        sink.send(np.array([value]), 3.0)
    assert len(sink) == 1 and sink.trajectory().q[0, 0] == 2.0


def test_misuse_is_reported():
    sink = RecorderSink(["a"])
    with pytest.raises(TrajectoryError, match="nothing was recorded"):
        sink.trajectory()
    with pytest.raises(TrajectoryError, match="shape"):
        sink.send(np.zeros(2), 0.0)
    sink.send(np.zeros(1), 1.0)
    with pytest.raises(TrajectoryError, match="after"):
        sink.send(np.zeros(1), 0.5)
    sink.clear()
    sink.send(np.zeros(1), 0.5)
    assert len(sink) == 1
