"""Tables of numbers that others wrote, such as CSV and TUM files: their columns, units and streams."""
