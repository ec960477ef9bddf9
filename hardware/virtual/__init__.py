"""A servo bus without servos: it speaks Protocol 2.0 byte for byte and its shafts take time to move.

``VirtualServo`` (memory, rules, motion, load) ← ``VirtualBus`` (packets in, packets out, faults) ←
``PtyPort`` (a serial port that any client can open) or ``SimBus`` (in process, on virtual time).  Shafts
follow their profiles; with a ``World`` a MuJoCo model of the arm moves them.
"""
