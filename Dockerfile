# docker build -t dashcalib_ros .
# docker run --rm dashcalib_ros dashcalib demo --out /tmp/demo
# docker run --rm --network host --ipc host -v "$HOME/.ros:/root/.ros" dashcalib_ros \
#     dashcalib-calibrator --ros-args -r image_raw:=/camera/image_raw -r camera_info:=/camera/camera_info
FROM ros:jazzy-ros-base

RUN apt-get update \
 && apt-get install -y --no-install-recommends python3-venv \
 && rm -rf /var/lib/apt/lists/*

# a virtual environment that sees apt's ROS; numpy<2, because apt's ROS is built with NumPy 1
ENV VIRTUAL_ENV=/opt/dashcalib
RUN python3 -m venv --system-site-packages "$VIRTUAL_ENV"
ENV PATH="$VIRTUAL_ENV/bin:$PATH"

COPY . /src/dashcalib_ros
RUN pip install --no-cache-dir 'numpy<2' /src/dashcalib_ros

# the package index, config/ and launch/ are under the virtual environment's share/
ENV AMENT_PREFIX_PATH="$VIRTUAL_ENV"
WORKDIR /data
# the base image's entry point sources /opt/ros/jazzy/setup.bash first
CMD ["dashcalib-calibrator"]
