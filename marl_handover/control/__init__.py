"""The closed loop: see, decide, plan, move, see again, on any backend."""
