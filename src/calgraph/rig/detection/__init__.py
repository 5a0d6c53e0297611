"""The board in one capture of a scanner or LiDAR."""
