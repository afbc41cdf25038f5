# The page on which people answer. Written without Docker, and so never built.
#
#   docker build -t sb3-poem .
#   docker run --rm -p 7860:7860 -v poem-answers:/answers sb3-poem
#
# It prints a link with a token; from this machine, http://localhost:7860/?token=... with the same
# token. What follows the image's name takes the place of --token: sb3-poem label's other arguments.
FROM python:3.11-slim

RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /sb3_poem
COPY constraints.txt .
# The page needs no GPU. For torch's CPU build, which is much smaller:
# --build-arg TORCH="--index-url ADDRESS torch" with the address that PyTorch names for it.
ARG TORCH=torch
RUN pip install --no-cache-dir -c constraints.txt ${TORCH}
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[label,metaworld]'

RUN useradd --create-home person && install -d -m 700 -o person /answers
USER person
WORKDIR /home/person
VOLUME /answers
EXPOSE 7860
ENV MUJOCO_GL=egl OMP_NUM_THREADS=1
ENTRYPOINT ["sb3-poem", "label", "--host", "0.0.0.0", "--store", "/answers"]
CMD ["--token"]
