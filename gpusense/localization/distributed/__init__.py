"""A filter whose particles are spread over several devices."""
