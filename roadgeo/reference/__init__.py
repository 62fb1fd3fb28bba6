"""A searchable road map: how it is built, stored, opened and listed."""
