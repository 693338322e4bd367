"""Everything about rosbags: read, salvage, write, add camera_info to images."""
