"""Positions from beacons without a filter: closed forms, least squares, and the covariance of their solutions."""
