"""`nlt stress`: the severity of a change at which each trained method breaks."""
