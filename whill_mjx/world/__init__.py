"""The world around a vehicle: scenes, solids, maps, looks, and the camera that draws them."""
