"""The server: references are kept open; clients post masks or photographs and receive their places."""
