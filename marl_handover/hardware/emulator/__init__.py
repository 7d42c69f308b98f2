"""Controller boards and servos that are not there: byte for byte what an SSC-32U does, on a pty or inside the process.

``board`` is a controller with its servos, ``device`` puts both behind a serial line with its pace and faults and wires a cell;
``sts3215`` is a bus servo, ``servo_bus`` the wire that such servos share. Only the two ends read a clock: ``pty`` and the URL scheme
``ssc32emu://name``.
"""
