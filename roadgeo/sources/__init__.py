"""Where data enters: road files, OpenStreetMap, masks."""
