"""Scenes drawn by trained methods, Open Image Denoise and path tracing: videos, and a viewer in the browser."""
