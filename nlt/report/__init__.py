"""Tables, figures, report.html and dashboard, from stored results alone."""
