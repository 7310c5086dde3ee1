// SPDX-License-Identifier: Apache-2.0
// The least that a GigE Vision camera costs: Aravis alone, each buffer taken and given back. The
// camera driver is measured beside it (camera_cost.py).
//   bare_aravis_loop ADDRESS WIDTH HEIGHT RATE PACKET_BYTES SECONDS
// prints frames and seconds of processor time.
#include <arv.h>
#include <sys/resource.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>

int main(int argc, char** argv) {
  if (argc != 7) return 2;
  GError* error = nullptr;
  ArvCamera* camera = arv_camera_new(argv[1], &error);
  if (!camera) {
    std::fprintf(stderr, "%s\n", error ? error->message : "no camera");
    return 1;
  }
  arv_camera_set_region(camera, 0, 0, std::atoi(argv[2]), std::atoi(argv[3]), nullptr);
  arv_camera_set_frame_rate(camera, std::atof(argv[4]), nullptr);
  arv_camera_gv_set_packet_size_adjustment(camera, ARV_GV_PACKET_SIZE_ADJUSTMENT_NEVER);
  arv_camera_gv_set_packet_size(camera, std::atoi(argv[5]), nullptr);
  arv_camera_gv_set_stream_options(camera, ARV_GV_STREAM_OPTION_PACKET_SOCKET_DISABLED);
  const guint payload = arv_camera_get_payload(camera, nullptr);
  ArvStream* stream = arv_camera_create_stream(camera, nullptr, nullptr, &error);
  if (!stream) return 1;
  g_object_set(stream, "socket-buffer", ARV_GV_STREAM_SOCKET_BUFFER_FIXED, "socket-buffer-size",
               8 << 20, nullptr);
  for (int i = 0; i < 8; ++i) arv_stream_push_buffer(stream, arv_buffer_new(payload, nullptr));
  arv_camera_start_acquisition(camera, nullptr);
  const auto processor = [] {
    rusage usage{};
    getrusage(RUSAGE_SELF, &usage);
    const auto seconds = [](const timeval& t) {
      return static_cast<double>(t.tv_sec) + 1e-6 * static_cast<double>(t.tv_usec);
    };
    return seconds(usage.ru_utime) + seconds(usage.ru_stime);
  };
  for (int i = 0; i < 30; ++i) {
    if (ArvBuffer* buffer = arv_stream_timeout_pop_buffer(stream, 2000000)) {
      arv_stream_push_buffer(stream, buffer);
    }
  }
  const double before = processor();
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(std::atoi(argv[6]));
  int frames = 0;
  while (std::chrono::steady_clock::now() < end) {
    ArvBuffer* buffer = arv_stream_timeout_pop_buffer(stream, 200000);
    if (!buffer) continue;
    frames += arv_buffer_get_status(buffer) == ARV_BUFFER_STATUS_SUCCESS ? 1 : 0;
    arv_stream_push_buffer(stream, buffer);
  }
  std::printf("%d %.3f\n", frames, processor() - before);
  arv_camera_stop_acquisition(camera, nullptr);
  g_object_unref(stream);
  g_object_unref(camera);
  return 0;
}
