# roadgeo with its search compiled: docker run --rm --network none roadgeo demo
FROM python:3.12-slim-bookworm

# Where numba and roadgeo keep what they compile: in the image, so that no container has to do it again.
ENV ROADGEO_CACHE=/opt/roadgeo/cache \
    PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1

RUN useradd --create-home --uid 1000 roadgeo \
    && mkdir -p /opt/roadgeo/cache /work \
    && chown -R roadgeo /opt/roadgeo /work

COPY --chown=roadgeo . /opt/roadgeo/source
RUN pip install --constraint /opt/roadgeo/source/constraints.txt /opt/roadgeo/source

USER 1000
WORKDIR /work
# The demonstration needs no network; running it once compiles everything.
RUN roadgeo demo && rm -rf roadgeo_demo

ENTRYPOINT ["roadgeo"]
CMD ["--help"]
