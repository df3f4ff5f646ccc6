"""People who walk around the vehicle.

crowd    who they are and where they go
law      how they walk
around   what they keep clear of
body     what they look like
contact  the vehicle among them
places   where they begin in any scene
"""
