"""Thousands of recordings replayed, by processes of this machine or of a cluster."""
