"""Where the objects are: positions, states, and the lines of sight that judge the sensors."""
