# radiotwin on the CPU, ray tracing included.
#
#   docker build -t radiotwin .
#   docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" radiotwin demo -o demo
FROM python:3.11-slim-bookworm AS build
RUN python -m venv /opt/radiotwin
ENV PATH=/opt/radiotwin/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
COPY constraints.txt ./
# The CPU build of torch: PyPI's for Linux brings gigabytes of CUDA. Nothing else is taken from that index.
RUN pip install --no-deps --index-url https://download.pytorch.org/whl/cpu "$(grep '^torch==' constraints.txt)"
# .git is not copied: --build-arg VERSION=1.2.3 is the version that the package has then.
ARG VERSION=0.1.0
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_RADIOTWIN=$VERSION
COPY pyproject.toml setup.py MANIFEST.in README.md LICENSE ./
COPY radiotwin ./radiotwin
COPY marl ./marl
COPY scenes ./scenes
RUN pip install -c constraints.txt '.[all]'

FROM python:3.11-slim-bookworm
# The version of a package would vanish from the archive with its next security update.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libllvm19 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/radiotwin /opt/radiotwin
# Caches lie where any user of `docker run --user` can write.
ENV PATH=/opt/radiotwin/bin:$PATH MPLBACKEND=Agg MPLCONFIGDIR=/tmp/matplotlib NUMBA_CACHE_DIR=/tmp/numba \
    XDG_CACHE_HOME=/tmp/cache
RUN useradd --create-home --uid 1000 radiotwin && install -d -o radiotwin /work
USER 1000
WORKDIR /work
ENTRYPOINT ["radiotwin"]
CMD ["--help"]
