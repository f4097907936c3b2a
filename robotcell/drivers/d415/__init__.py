"""The Intel RealSense D415 over librealsense."""
