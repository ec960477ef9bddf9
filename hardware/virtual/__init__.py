"""Virtual servos on a virtual bus that speaks the wire protocol byte for byte.

``VirtualServo`` and ``VirtualSts3215`` hold memory, rules, motion and load of one servo.
``VirtualBus`` takes instruction packets, returns status packets and injects faults. ``PtyPort``
serves a bus on a serial port that any client can open. ``SimBus`` serves it in process, on virtual
time. Shafts take time to move: they follow their profiles, or a ``World`` moves them with a MuJoCo
model of the arm.
"""
