"""Surgical arms: bodies, drives and kinematics."""
