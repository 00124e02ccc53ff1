"""Files in and out: walks (CSV, Parquet), maps (ROS), and the way from positions to moves on a grid."""
