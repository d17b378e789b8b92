"""Objects and tables as text."""
