"""The vehicle: its spec, parameters, rigid bodies and one physics step."""
