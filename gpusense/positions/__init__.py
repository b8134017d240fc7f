"""Compute positions from beacons without a filter: closed forms, least squares and covariances."""
