# Builds from the wheel, with nothing of the sources left behind:
#   docker build -t matd3_jax .                                for CPUs
#   docker build -t matd3_jax:cuda --build-arg EXTRAS=cuda .   for NVIDIA GPUs, run with --gpus all
# Runs go to /work, which belongs to whoever runs it:
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" matd3_jax train env=simple_spread algo=matd3 seeds=4
FROM python:3.12-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY src src
RUN pip install --no-cache-dir build && python -m build --wheel --outdir /wheels

FROM python:3.12-slim
ARG EXTRAS=""
# MuJoCo draws films without a display by OSMesa.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libosmesa6 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=osmesa
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(echo /wheels/*.whl)${EXTRAS:+[$EXTRAS]}" && rm -r /wheels
# Compiled programs and fonts are kept where any user may write.
ENV HOME=/tmp XDG_CACHE_HOME=/tmp/cache
WORKDIR /work
ENTRYPOINT ["matd3"]
CMD ["--help"]
