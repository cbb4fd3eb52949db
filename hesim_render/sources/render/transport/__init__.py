"""Light transport: paths whose rays have individual times, and direct light on diffuse surfaces in closed form."""
