"""The cell in PyBullet: both arms under servo control, a grasp by friction, a camera. The only folder that imports pybullet."""
