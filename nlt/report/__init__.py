"""Tables, figures, report.html and dashboard, made from stored results alone."""
