"""Scenes, movable objects, states, cameras and point clouds."""
