"""The bus in process: a client and virtual servos on virtual time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from robot_ik.errors import BusCorruptError, BusNotOpenError, BusTimeoutError, ServoRefusedError
from robot_ik.hardware.bus import BROADCAST_ID, BusStatus, ServoBus
from robot_ik.hardware.config import ArmConfig
from robot_ik.hardware.families.dynamixel_x_table import X_TABLES
from robot_ik.hardware.simulated import SimBus
from robot_ik.hardware.virtual.bus import VirtualBus
from robot_ik.hardware.virtual.faults import Fault
from robot_ik.ports import VirtualClock

TABLE = X_TABLES["XM430-W350"]
PRESENT = TABLE["present_position"]
GOAL = TABLE["goal_position"]
TORQUE = TABLE["torque_enable"]


def test_simbus_is_a_servo_bus(sim: SimBus, arm_config: ArmConfig) -> None:
    assert isinstance(sim, ServoBus)
    assert sim.ping(4) == 1060
    assert sim.broadcast_ping() == {1: 1020, 2: 1020, 3: 1020, 4: 1060, 5: 1060, 6: 1020}


def test_simbus_moves_the_arm_on_virtual_time(
    sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig, clock: VirtualClock
) -> None:
    goal = np.array([0.5, -0.5, 0.25, 1.0, -1.0, 0.1])
    assert sim.write(BROADCAST_ID, TORQUE, 1) == BusStatus(BROADCAST_ID, None)
    sim.sync_write(
        GOAL, {j.servo.id: j.nearest_ticks(q) for j, q in zip(arm_config.joints, goal, strict=True)}
    )
    clock.sleep_until(10.0)
    read = sim.sync_read(arm_config.servo_ids, PRESENT)
    q = [j.value(read[j.servo.id].data or 0) for j in arm_config.joints]
    assert np.abs(q - goal).max() <= arm_config.resolution.max() / 2
    assert arm_bus.true_angles(arm_config) == pytest.approx(q)


def test_simbus_reads_signed_values(sim: SimBus, clock: VirtualClock) -> None:
    sim.write(1, TORQUE, 1)
    sim.write(1, GOAL, -12_345)
    clock.sleep_until(20.0)
    assert sim.read(1, PRESENT).data == -12_345
    with pytest.raises(ValueError, match="fit"):
        sim.write(1, TORQUE, 300)


@pytest.mark.parametrize(
    "call",
    [
        lambda sim: sim.ping(1),
        lambda sim: sim.broadcast_ping(),
        lambda sim: sim.read(1, PRESENT),
        lambda sim: sim.write(1, TORQUE, 1),
        lambda sim: sim.sync_read([1], PRESENT),
        lambda sim: sim.sync_write(TORQUE, {1: 1}),
        lambda sim: sim.reboot(1),
    ],
)
def test_simbus_must_be_open(
    sim: SimBus, arm_bus: VirtualBus, call: Callable[[SimBus], object]
) -> None:
    sim.close()
    sim.close()
    with pytest.raises(BusNotOpenError):
        call(sim)
    assert not arm_bus.servo(1).torque


def test_simbus_names_the_silent_and_the_refusing(
    sim: SimBus, arm_bus: VirtualBus, clock: VirtualClock
) -> None:
    sim.read(3, PRESENT)
    clock.sleep_until(2.5)
    arm_bus.inject(Fault("silent", 3))
    with pytest.raises(BusTimeoutError) as silent:
        sim.read(3, PRESENT)
    assert (silent.value.id, silent.value.register, silent.value.port) == (
        3,
        "present_position",
        "sim",
    )
    assert silent.value.last_good == pytest.approx(2.5)
    with pytest.raises(ServoRefusedError) as refused:
        sim.write(1, GOAL, 1_048_576)
    assert (refused.value.id, refused.value.code) == (1, 4)


def test_simbus_sync_read_keeps_the_replies_that_came(
    sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig
) -> None:
    arm_bus.inject(Fault("silent", 2), Fault("overload", 5))
    read = sim.sync_read(arm_config.servo_ids, PRESENT)
    assert list(read) == list(arm_config.servo_ids)
    assert read[2] == BusStatus(2, None)
    assert [id for id, status in read.items() if status.alert] == [5]
    assert read[5].data == 2048  # an alert is information: the data are good
    assert (sim.counters.timeouts, sim.counters.cycles, sim.counters.retries) == (1, 1, 2)


def test_simbus_sync_read_carries_refusals(sim: SimBus) -> None:
    # Current Limit is at 38 on an XM430 and nothing is there on an XL430 (id 4).
    read = sim.sync_read([1, 4], TABLE["current_limit"])
    assert read == {1: BusStatus(1, 1193), 4: BusStatus(4, None, 7)}


def test_simbus_reboot_clears_an_overload(sim: SimBus, arm_bus: VirtualBus) -> None:
    sim.write(5, X_TABLES["XL430-W250"]["torque_enable"], 1)
    arm_bus.inject(Fault("overload", 5))
    assert sim.read(5, TABLE["hardware_error_status"]) == BusStatus(5, 32, 0, True)
    assert sim.read(5, TORQUE).data == 0
    sim.reboot(5)
    assert sim.read(5, TABLE["hardware_error_status"]) == BusStatus(5, 0, 0, False)


@pytest.mark.parametrize("fault", ["corrupt", "truncate", "drop", "garbage"])
def test_no_wrong_value_comes_through_a_bad_wire(
    sim: SimBus, arm_bus: VirtualBus, arm_config: ArmConfig, fault: str
) -> None:
    right = {id: status.data for id, status in sim.sync_read(arm_config.servo_ids, PRESENT).items()}
    arm_bus.reseed(5)
    arm_bus.inject(Fault(fault, value=0.2))
    seen = [sim.sync_read(arm_config.servo_ids, PRESENT) for _ in range(200)]
    values = [status.data for read in seen for status in read.values()]
    assert all(s.data in (None, right[id]) for read in seen for id, s in read.items())
    # Three tries at 0.2: 0.8 % stay without a reply; of 1200 that is about 10.
    missing = values.count(None)
    assert missing < 40
    assert sim.counters.timeouts == missing
    assert (sim.counters.retries > 20) or fault == "garbage"


def test_a_wire_that_spoils_everything_is_called_corrupt(sim: SimBus, arm_bus: VirtualBus) -> None:
    arm_bus.servo(1).memory.set("id", 2)  # two servos with one id at different places
    with pytest.raises(BusCorruptError, match="two servos"):
        sim.read(2, PRESENT)


def test_local_echo_is_read_over(sim: SimBus, arm_bus: VirtualBus) -> None:
    arm_bus.inject(Fault("echo"))
    assert sim.read(1, PRESENT).data == 2048
    assert sim.broadcast_ping()[6] == 1020
