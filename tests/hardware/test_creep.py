"""A loaded arm does not sink while the heartbeat, a watchdog or a repeated pose holds it."""

from __future__ import annotations

import dataclasses
import threading
import time

import mujoco
import numpy as np
import pytest

from robot_ik.errors import ConfigError
from robot_ik.hardware import open_arm
from robot_ik.hardware.arm import ArmState
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.world import World
from robot_ik.hardware.watchdogs import BEAT, min_watchdog_ms
from robot_ik.ports import RealClock, VirtualClock

# One lever, level at q = 0: about half of an XM430-W350's stall torque at the shoulder.
LEVER = """
<mujoco><worldbody><body><joint name="shoulder" axis="0 -1 0"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".01" mass="1.2"/>
</body></worldbody></mujoco>
"""

LIMIT = np.radians(0.1)


class Loaded:
    """A lever against gravity, and what its shaft did."""

    def __init__(self, clock, **bus) -> None:
        plain = ArmConfig.generic("lever", ["shoulder"], [-3], [3])
        self.config = dataclasses.replace(plain, **bus)
        self.servos = VirtualBus.from_config(self.config, clock, [0.0])
        self.world = World(mujoco.MjModel.from_xml_string(LEVER), self.config, self.servos)
        self.arm = open_arm(
            self.config,
            "sim" if isinstance(clock, VirtualClock) else "pty",
            virtual_bus=self.servos,
        )

    def q(self) -> float:
        with self.servos.lock:
            self.servos.advance()
            return float(self.world.data.qpos[0])


def lowest_after_the_first_second(loaded: Loaded, command, seconds: float) -> tuple[float, float]:
    """Return the height at one second and the lowest after it, rad, while ``command`` runs."""
    seen: list[float] = []
    over = threading.Event()

    def look() -> None:
        time.sleep(1.0)
        while not over.is_set():
            seen.append(loaded.q())
            time.sleep(0.005)

    watcher = threading.Thread(target=look)
    watcher.start()
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end:
            command()
    finally:
        over.set()
        watcher.join()
    return seen[0], min(seen)


WAYS = {
    "the same pose every 0.3 s": lambda arm: (arm.send([0.0], time.monotonic()), time.sleep(0.3)),
    "the same pose every 0.6 s": lambda arm: (arm.send([0.0], time.monotonic()), time.sleep(0.6)),
    "one pose, then silence": lambda arm: time.sleep(0.1),
}


def stays_up(way: str, seconds: float, **bus) -> None:
    loaded = Loaded(RealClock(), **bus)
    with loaded.arm as arm:
        arm.enable()
        for k in range(10):
            arm.send([0.0], 0.01 * k)
            time.sleep(0.01)
        first, lowest = lowest_after_the_first_second(loaded, lambda: WAYS[way](arm), seconds)
        assert first - lowest < LIMIT
        assert arm.state in (ArmState.HOLD, ArmState.ENABLED)
    assert np.isfinite(first)


@pytest.mark.parametrize("way", WAYS)
def test_a_held_arm_does_not_sink(way, real_time):
    stays_up(way, 2.5)


def test_nor_with_the_shortest_watchdog_that_is_allowed(real_time):
    stale = 40
    stays_up(
        "one pose, then silence", 2.5, stale_ms=stale, watchdog_ms=min_watchdog_ms(stale, 0.01)
    )


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("way", WAYS)
def test_a_held_arm_does_not_sink_in_a_minute(way, real_time):
    stays_up(way, 61.0)


def test_pauses_in_which_the_bus_watchdog_trips_do_not_add_up():
    loaded = Loaded(VirtualClock())
    with loaded.arm as arm:
        arm.enable()
        heights = []
        for k in range(40):
            arm.clock.sleep_until(arm.clock.now() + 0.5)
            arm.send([0.0], arm.clock.now())
            if k >= 2:
                heights.append(loaded.q())
        assert max(heights) - min(heights) < LIMIT


def test_yielding_is_decided_once_when_holding_begins():
    loaded = Loaded(VirtualClock())
    with loaded.arm as arm:
        arm.enable()
        arm.send([0.0], 0.0)
        arm.hold()
        goal = loaded.servos.servo(1).memory.values["goal_position"]
        for _ in range(30):
            arm.clock.sleep_until(arm.clock.now() + 0.5)
            arm.hold()
            arm.read()
            assert loaded.servos.servo(1).memory.values["goal_position"] == goal


def test_a_joint_that_is_pushed_while_it_is_held_never_yields(arm_config, start, stream):
    """It keeps its goal in ``hold``, after a tripped Bus Watchdog, and when the arm is left."""
    with open_arm(arm_config, "sim", start=start, on_exit="hold") as arm:
        arm.enable()
        stream(arm, [start] * 3)
        arm.hold()
        servo = arm.bus.virtual_bus.servo(2)
        goal = servo.memory.values["goal_position"]
        servo.stuck = True
        there = servo.shaft.stuck_at
        # the last two trip it
        for push, pause in ((200, 0.05), (-300, 0.05), (250, 0.5), (-350, 0.5)):
            servo.shaft.stuck_at = there + push
            arm.clock.sleep_until(arm.clock.now() + pause)
            arm.read()
            arm.hold()
            assert abs(servo.shaft.reading - goal) > 150
            assert servo.memory.values["goal_position"] == goal
    assert arm.exit_report.ok and servo.memory.values["goal_position"] == goal


def test_a_joint_that_is_pushed_away_yields_when_holding_begins(arm, stream, start):
    arm.enable()
    stream(arm, [start] * 3)
    arm.bus.virtual_bus.servo(2).stuck = True
    stream(arm, [start + 0.002 * k for k in range(80)])  # joint2 is kept 0.16 rad back
    arm.hold()
    goals = {drive.name: drive.value(arm._cycle.goals[drive.id]) for drive in arm.config.drives}
    assert abs(goals["joint2"] - start[1]) < 0.02 and abs(goals["joint1"] - start[0] - 0.158) < 0.02


@pytest.mark.parametrize("watchdog", [40, 60, 200, 260])
def test_a_watchdog_ahead_of_the_heartbeat_is_refused_with_the_least_value(arm_toml, watchdog):
    text = arm_toml.replace("watchdog_ms = 200", f"watchdog_ms = {watchdog}\nstale_ms = 200")
    with pytest.raises(ConfigError, match=r"(?s)bus\.watchdog_ms.*280 or more"):
        ArmConfig.parse(text)


def test_the_least_value_is_accepted_and_one_step_less_is_not(arm_toml):
    for stale, rate in ((0.2, 100.0), (0.05, 30.0), (0.5, 200.0), (0.001, 50.0)):
        least = min_watchdog_ms(round(1000 * stale), 1.0 / rate)
        assert max(stale, 3 / rate) + BEAT + 2 / rate < 0.001 * least
        base = ArmConfig.parse(arm_toml)
        dataclasses.replace(base, rate_hz=rate, stale_ms=round(1000 * stale), watchdog_ms=least)
        with pytest.raises(ConfigError):
            dataclasses.replace(
                base, rate_hz=rate, stale_ms=round(1000 * stale), watchdog_ms=least - 20
            )


def test_a_file_that_names_only_the_watchdog_gets_half_of_it(arm_toml):
    assert (
        ArmConfig.parse(arm_toml.replace("watchdog_ms = 200", "watchdog_ms = 600")).stale_ms == 300
    )
    plain = ArmConfig.parse(arm_toml.replace("watchdog_ms = 200", ""))
    assert (plain.watchdog_ms, plain.stale_ms) == (400, 200)


def test_the_least_value_that_is_named_is_accepted(arm_toml):
    for watchdog in (40, 60, 100, 120, 140):
        text = arm_toml.replace("watchdog_ms = 200", f"watchdog_ms = {watchdog}")
        with pytest.raises(ConfigError) as refused:
            ArmConfig.parse(text)
        least = int(refused.value.allowed.split()[0])
        ArmConfig.parse(text.replace(f"watchdog_ms = {watchdog}", f"watchdog_ms = {least}"))
        with pytest.raises(ConfigError):
            ArmConfig.parse(
                text.replace(f"watchdog_ms = {watchdog}", f"watchdog_ms = {least - 20}")
            )


def test_without_a_heartbeat_the_arm_warns(arm_config, caplog):
    with (
        open_arm(dataclasses.replace(arm_config, stale_ms=0), "sim") as arm,
        caplog.at_level("WARNING"),
    ):
        arm.enable()
    assert any("stale_ms = 0" in record.getMessage() for record in caplog.records)
