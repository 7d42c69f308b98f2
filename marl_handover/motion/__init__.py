"""How an arm carries out a command: splines, collision-free paths, timing, and the executor agent that plays an arm."""
