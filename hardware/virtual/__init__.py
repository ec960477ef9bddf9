"""A servo bus without servos: it speaks Protocol 2.0 byte for byte and its shafts take time to move.

``VirtualServo`` (memory and motion) ← ``VirtualBus`` (packets in, packets out) ← ``PtyPort`` (a serial
port that any client can open) or ``SimBus`` (in process, on virtual time).
"""
