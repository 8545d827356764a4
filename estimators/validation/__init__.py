"""Models held against measurements that they may not have seen."""
