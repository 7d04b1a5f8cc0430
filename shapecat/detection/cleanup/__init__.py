"""Clean-up: what is no object is rejected, holes and the contact boundary are filled."""
