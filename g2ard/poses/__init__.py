"""Cameras for a scene without views: around objects, through rooms and streets, from the air.

A scene is turned upright (`up`), freed of floaters and sky (`matter`), and its free space mapped (`site`).
Planners (`outside`, `within`) propose poses from endless even sequences, and keep those that stand in free
space and see enough (`sight`). `pool` combines them; `showing` chooses the views that show a scene best.
"""

from g2ard.poses.pool import Pool, make_pool, plan_pool
from g2ard.poses.showing import best_views, turntable

__all__ = ["Pool", "best_views", "make_pool", "plan_pool", "turntable"]
