"""Scenes drawn by trained methods, Open Image Denoise and path tracing: videos, contact sheets, a viewer."""
