"""The served D415: images over TCP, and the software device that plays them to librealsense."""
