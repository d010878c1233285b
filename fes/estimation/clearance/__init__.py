"""Clearance of toe and heel, and where they are on the foot."""
