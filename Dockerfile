# g2ard on the command line: docker run --rm -v "$PWD:/work" g2ard simplify scene.ply -r 10 -o small.ply
# Build the wheel first (make wheel-linux); the image installs dist/*.whl and needs no compiler.
FROM python:3.13-slim
COPY dist/*.whl /tmp/
RUN pip install --no-cache-dir /tmp/*.whl && rm /tmp/*.whl && useradd --create-home --uid 1000 g2ard
USER g2ard
WORKDIR /work
ENTRYPOINT ["g2ard"]
