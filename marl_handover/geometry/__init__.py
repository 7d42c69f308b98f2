"""Poses, arms read from a URDF, their kinematics and the shapes around their links. Lengths in mm, angles in rad.

Forward and inverse kinematics, Jacobians, distances between segments and the way from a base to the world are written here and nowhere
else; the safety filter of :mod:`marl_handover.hardware` keeps forward kinematics of its own, so that it does not share a mistake.
"""
