"""Road networks as plane graphs: traced from masks or drawn from maps, simplified, with their intersections."""
