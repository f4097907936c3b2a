"""Transforms, the arm's kinematics, the gripper's linkage, and the bodies that must not touch."""
