"""Published measured sets, in their original form."""
