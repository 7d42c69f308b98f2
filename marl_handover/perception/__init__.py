"""Cameras, their calibration, and where the block and its goal lie. The only folder that imports OpenCV.

Pictures are BGR uint8 (height, width, 3), as OpenCV has them; a pixel's centre has whole coordinates. ``T_camera_world`` takes points of
the world (origin midway between the bases, +z up, mm) into the camera's frame (x right, y down, z into the picture).
"""
