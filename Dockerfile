# whill-mjx with JAX for CPUs, or for NVIDIA GPUs with --build-arg EXTRA=[cuda]. The tests check its files, and build no image.
#
#     docker build -t whill-mjx .
#     docker run --rm -v "$PWD/runs:/home/driver/runs" whill-mjx python -m whill_mjx.train --out runs/train
FROM python:3.12-slim
ARG EXTRA=""

# Pictures of robots and scenes need a software OpenGL.
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1 libosmesa6 && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl PYTHONUNBUFFERED=1

WORKDIR /opt/whill-mjx
COPY pyproject.toml constraints.txt MANIFEST.in README.md LICENSE CHANGELOG.md ./
COPY whill_mjx whill_mjx
COPY sysid sysid
COPY dreamer dreamer
COPY bridge bridge
RUN pip install --no-cache-dir -c constraints.txt ".${EXTRA}"

RUN useradd --create-home driver && mkdir -p /home/driver/runs && chown -R driver /home/driver
USER driver
WORKDIR /home/driver
CMD ["python", "-m", "whill_mjx"]
