"""Known objects: which of a catalogue's satellites an object of the night is."""
