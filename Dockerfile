# BlinkGL in a container: for the CPU (software OpenGL) and for NVIDIA cards (EGL of the driver).
#
#   docker build --target cpu -t blinkgl:cpu .
#   docker run --rm -v "$PWD/out:/work/out" blinkgl:cpu generate /opt/blinkgl/configs/demo.yaml --out out/demo
#
#   docker build --target nvidia -t blinkgl:nvidia .
#   docker run --rm --gpus all -v "$PWD/out:/work/out" blinkgl:nvidia doctor
#
# tests/test_packaging.py compares what it installs with tools/setup.sh.

FROM debian:bookworm-slim AS cpu
ENV DEBIAN_FRONTEND=noninteractive PIP_DISABLE_PIP_VERSION_CHECK=1 PATH=/opt/blinkgl/venv/bin:$PATH
RUN apt-get update -q && apt-get install -y -q --no-install-recommends python3 python3-venv libegl1 libgl1 libgl1-mesa-dri libosmesa6 && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/blinkgl/venv
WORKDIR /opt/blinkgl/source
COPY setup.cfg setup.py pyproject.toml constraints.txt README.md LICENSE ./
COPY blinkgl ./blinkgl
COPY eflow ./eflow
COPY shaders ./shaders
COPY configs ./configs
COPY tools ./tools
RUN pip install -q --no-cache-dir -c constraints.txt --upgrade pip setuptools wheel && pip install -q --no-cache-dir --no-build-isolation -c constraints.txt ".[physics]"
RUN mv configs /opt/blinkgl/configs && rm -rf /opt/blinkgl/source/* && cd / && python -m blinkgl.show.compile_kernels
RUN useradd --create-home blinkgl && install -d -o blinkgl /work
USER blinkgl
WORKDIR /work
ENTRYPOINT ["blinkgl"]
CMD ["doctor"]

# The driver's libraries come from the host when the container starts; they need the capability "graphics", and glvnd has to be told their name.
FROM cpu AS nvidia
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,graphics,utility
USER root
RUN mkdir -p /usr/share/glvnd/egl_vendor.d && printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_nvidia.so.0"}}\n' > /usr/share/glvnd/egl_vendor.d/10_nvidia.json
USER blinkgl
