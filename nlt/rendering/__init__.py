"""Rendering: the Mitsuba variant, integrators, the G-buffer and photons."""
