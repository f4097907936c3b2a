"""The UR5e over RTDE and its dashboard."""
