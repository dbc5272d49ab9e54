"""Cameras for a scene without views: around objects, through rooms and streets, from the air.

A scene is turned upright (`up`), freed of floaters and sky (`matter`), and its free space mapped (`site`).
Planners (`outside`, `within`) propose poses from endless even sequences, and keep those that stand in free
space and see enough (`sight`). `pool` combines them.
"""

from g2ard.poses.pool import Pool, make_pool, plan_pool

__all__ = ["Pool", "make_pool", "plan_pool"]
