"""The twin's arm, gripper, camera and clock, and the backend that opens them."""
