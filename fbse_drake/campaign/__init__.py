"""Campaigns: many runs of the same steps, each of which becomes a row."""
