"""The rule book, problems, observation layouts and the exact planner."""
