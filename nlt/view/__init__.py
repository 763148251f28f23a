"""`nlt view`: a scene in the browser, drawn by trained methods, Open Image Denoise and path tracing."""
