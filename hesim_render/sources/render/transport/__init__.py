"""Light transport: paths whose rays have individual times, and direct light on matt surfaces in closed form."""
