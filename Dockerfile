# The server as an image: CPU only, non-root, all state under /data.
#   docker build -t roel .
#   docker run -v roel-data:/data -p 127.0.0.1:50051:50051 roel
# Calls are not encrypted: publish the port on loopback or inside a trusted network alone.

FROM python:3.11-slim-bookworm AS build
# Without this index torch is the CUDA build, which is several gigabytes larger.
ARG PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
WORKDIR /src
COPY pyproject.toml README.md LICENSE ./
COPY roel_service roel_service
COPY clients clients
COPY bench/roel_bench bench/roel_bench
RUN python -m venv /opt/roel && /opt/roel/bin/pip install --no-cache-dir .

FROM python:3.11-slim-bookworm
COPY .ci/system_libraries /usr/local/sbin/system_libraries
RUN system_libraries \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --create-home roel \
    && install -d -o 10001 /data /var/cache/roel
COPY --from=build /opt/roel /opt/roel
# The kernels are compiled at build time, into a folder that the server's user may write: numba
# refuses a cache it cannot write to.
ENV PATH=/opt/roel/bin:$PATH NUMBA_CACHE_DIR=/var/cache/roel PYTHONUNBUFFERED=1
USER 10001
RUN roel demo
VOLUME /data
EXPOSE 50051
# Docker's default stop signal, SIGTERM, drains: open calls end, then the server exits with 0.
HEALTHCHECK --interval=10s --timeout=5s --start-period=20s CMD ["roel", "health", "--server", "127.0.0.1:50051"]
CMD ["roel", "serve", "--data", "/data", "--host", "0.0.0.0", "--insecure"]
