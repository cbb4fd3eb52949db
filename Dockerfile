# The command line of hesim_render on a slim Debian:
#   docker build -t hesim-render .
#   docker run --rm -v "$PWD:/data" hesim-render demo --out demo
FROM python:3.12-slim-bookworm
WORKDIR /src
COPY . .
RUN python -m venv /opt/hesim
RUN /opt/hesim/bin/pip install --no-cache-dir '.[llvm,targets,meshes,cubes]'
RUN /opt/hesim/bin/hesim-render info
RUN useradd --create-home hesim && mkdir /data && chown hesim /data
USER hesim
WORKDIR /data
ENTRYPOINT ["/opt/hesim/bin/hesim-render"]
CMD ["--help"]
