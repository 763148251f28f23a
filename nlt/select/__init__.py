"""`nlt select`: the smallest model that a scene needs."""
