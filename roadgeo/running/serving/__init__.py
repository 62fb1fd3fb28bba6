"""The server: references are kept open, and who posts a mask or a photograph is told where it lies."""
