// SPDX-License-Identifier: Apache-2.0
#include "omnister/sim/simulated_camera.h"

#include <cmath>
#include <thread>

#include "omnister/common/numbers.h"

namespace omnister::sim {
namespace {

using std::chrono::nanoseconds;
using Steady = std::chrono::steady_clock;

nanoseconds duration(double s) { return nanoseconds(std::llround(s * 1e9)); }

class SimulatedCamera : public device::Camera {
 public:
  SimulatedCamera(const SimulatedCameraOptions& options, SceneAt scene, PoseAt pose)
      : options_(options),
        scene_(std::move(scene)),
        pose_(std::move(pose)),
        renderer_(*options.lens, options.size, options.render.threads) {}

  device::CameraIdentity identity() const override {
    return {"omnister", "simulated camera", options_.serial};
  }

  void start() override {
    running_ = true;
    due_ = Steady::now();
  }

  void stop() override { running_ = false; }

  std::optional<device::Frame> grab(std::chrono::milliseconds timeout) override {
    const Steady::time_point until = Steady::now() + timeout;
    const nanoseconds exposure = duration(options_.exposure_s);
    if (!running_ || due_ + exposure > until) {
      std::this_thread::sleep_until(until);
      return std::nullopt;
    }
    // A frame that could not be begun in time is begun now: none is made up afterwards.
    const Steady::time_point begin = std::max(due_, Steady::now());
    std::this_thread::sleep_until(begin + exposure);
    due_ = begin + duration(1.0 / options_.frame_rate_hz);

    device::Frame frame;
    frame.stamp = device::now() - exposure / 2;
    frame.sequence = ++sequence_;
    RenderOptions render = options_.render;
    render.seed += sequence_;
    frame.image = renderer_.render(*scene_(frame.stamp), pose_(frame.stamp), render).image;
    frame.encoding = render.color ? "bgr8" : "mono8";
    return frame;
  }

 private:
  const SimulatedCameraOptions options_;
  const SceneAt scene_;
  const PoseAt pose_;
  const Renderer renderer_;
  bool running_ = false;
  std::uint64_t sequence_ = 0;
  Steady::time_point due_;
};

}  // namespace

std::unique_ptr<device::Camera> makeSimulatedCamera(const SimulatedCameraOptions& options,
                                                    SceneAt scene, PoseAt pose) {
  const auto within = [](const char* key, double value, double min, double max) {
    if (value >= min && value <= max) return;
    throw InputError("simulated camera", key,
                     "is " + formatNumber(value) + ", expected " + formatNumber(min) + " to " +
                         formatNumber(max));
  };
  within("frame_rate", options.frame_rate_hz, 0.01, 1000.0);
  within("exposure", options.exposure_s, 0.0, 1.0);
  if (!options.lens) throw InputError("simulated camera", "lens", "is missing");
  return std::make_unique<SimulatedCamera>(options, std::move(scene), std::move(pose));
}

}  // namespace omnister::sim
