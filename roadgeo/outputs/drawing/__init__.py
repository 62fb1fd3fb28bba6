"""All pictures: lists of layers (`layers`, `views`), a writer of SVG and a writer of pixels that draw them alike."""
