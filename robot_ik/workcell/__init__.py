"""A robot and its arm together."""
