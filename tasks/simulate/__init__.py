"""A scene to what its sensors see."""
