# For amd64 and arm64, as its base. See "In a container" in docs/usage.md.
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

# no root; with `docker run --user` it is the caller, who may write into this home and /data too
RUN useradd --create-home dashcalib \
 && mkdir -p /data /home/dashcalib/.ros \
 && chmod 1777 /data /home/dashcalib /home/dashcalib/.ros
USER dashcalib
ENV HOME=/home/dashcalib

# the package index, config/ and launch/ are under the virtual environment's share/
ENV AMENT_PREFIX_PATH="$VIRTUAL_ENV"
WORKDIR /data
# the base image's entry point sources /opt/ros/jazzy/setup.bash first
CMD ["dashcalib-calibrator"]
