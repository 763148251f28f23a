"""Everything that traces a ray."""
