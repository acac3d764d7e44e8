"""What the association works on: tracklets of all sensors at common instants."""
