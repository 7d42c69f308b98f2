"""Controller boards and servos that are not there: byte for byte what an SSC-32U does, on a pty or inside the process.

``board`` is the controller, ``servo`` what is plugged into it, ``device`` puts both behind a serial line with its pace and faults, ``cell``
builds what a cell's settings ask for. Only the two ends read a clock: ``pty`` and the URL scheme ``ssc32emu://name``.
"""
