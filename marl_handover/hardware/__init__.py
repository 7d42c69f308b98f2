"""Servo arms on SSC-32 class controllers: protocol, driver, servo calibration, safety filter, streaming, and an emulated board.

Order of use: :mod:`~marl_handover.hardware.settings` say what is wired where, :mod:`~marl_handover.hardware.driver` connects and moves,
:mod:`~marl_handover.control.trajectory_player` plays planned motions, :mod:`~marl_handover.hardware.emulator` stands in for the boards.
"""
