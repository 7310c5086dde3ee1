// SPDX-License-Identifier: Apache-2.0
#include "device/camera/aravis/aravis_connection.h"

#include <condition_variable>
#include <deque>
#include <mutex>
#include <thread>

#include "device/camera/aravis/aravis_discovery.h"

namespace omnister::device {
namespace {

/// Dead devices are closed here: each of their objects takes seconds to give up.
class Closer {
 public:
  static Closer& instance() {
    static Closer closer;
    return closer;
  }
  void take(Object<ArvStream> stream, Object<ArvCamera> camera) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      waiting_.push_back({std::move(camera), std::move(stream)});
      if (!thread_.joinable()) thread_ = std::thread(&Closer::run, this);
    }
    wake_.notify_all();
  }
  ~Closer() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      end_ = true;
    }
    wake_.notify_all();
    if (thread_.joinable()) thread_.join();
  }

 private:
  struct Dead {
    Object<ArvCamera> camera;
    Object<ArvStream> stream;  // goes first
  };
  void run() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      wake_.wait(lock, [this] { return end_ || !waiting_.empty(); });
      if (waiting_.empty()) return;
      {
        const Dead dead = std::move(waiting_.front());
        waiting_.pop_front();
        lock.unlock();
        Failure ignored;
        if (dead.stream) arv_camera_stop_acquisition(dead.camera.get(), ignored.out());
      }
      lock.lock();
    }
  }
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<Dead> waiting_;
  bool end_ = false;
  std::thread thread_;
};

}  // namespace

AravisConnection::AravisConnection(AravisDevice device, std::vector<std::string> remarks)
    : device_(std::move(device)), remarks_(std::move(remarks)) {
  Failure failure;
  Object<ArvDevice> opened;
  if (gige()) {
    const std::optional<in_addr> address = parseAddress(device_.address);
    if (!address) throw CameraError("the camera has no IP address");
    const std::string own = interfaceTowards(*address);
    // The local address that packets to the camera leave from: discovery may have seen it through
    // another interface, on which its stream would not arrive.
    const Object<GInetAddress> interface(g_inet_address_new_from_string(own.c_str()));
    const Object<GInetAddress> remote(g_inet_address_new_from_string(device_.address.c_str()));
    if (!interface || !remote) throw CameraError("no way to " + device_.address);
    local_ = own == device_.address || own.rfind("127.", 0) == 0;
    opened.reset(arv_gv_device_new(interface.get(), remote.get(), failure.out()));
    if (opened && !arv_gv_device_is_controller(ARV_GV_DEVICE(opened.get()))) throwBusy();
  } else {
    opened.reset(arv_open_device(device_.id.c_str(), failure.out()));
  }
  if (failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_ACCESS_DENIED) ||
      failure.is(ARV_DEVICE_ERROR_NOT_CONTROLLER) ||
      failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_BUSY)) {
    throwBusy();
  }
  if (failure || !opened) throwCannotOpen(failure.text());
  camera_.reset(arv_camera_new_with_device(opened.get(), failure.out()));
  if (failure || !camera_) throwCannotOpen(failure.text());
  // The heart beat may lose it while this object is being closed.
  g_signal_connect_data(
      opened.get(), "control-lost", G_CALLBACK(&AravisConnection::onControlLost),
      new std::shared_ptr<std::atomic<bool>>(lost_),
      [](gpointer lost, GClosure*) {
        delete static_cast<std::shared_ptr<std::atomic<bool>>*>(lost);
      },
      GConnectFlags(0));
}

AravisConnection::~AravisConnection() {
  if (gone()) Closer::instance().take(nullptr, std::move(camera_));
}

void AravisConnection::closeLater(Object<ArvStream> stream) {
  Closer::instance().take(std::move(stream),
                          Object<ArvCamera>(ARV_CAMERA(g_object_ref(camera_.get()))));
}

void AravisConnection::throwBusy() const {
  throw CameraError(describe(device_) + " is busy: another program controls it");
}

void AravisConnection::throwCannotOpen(const std::string& why) const {
  std::string text =
      describe(device_) + " cannot be opened: " + (why.empty() ? "no reason given" : why);
  const std::string low = lower(why);
  if (device_.protocol == "USB3Vision" &&
      (low.find("access") != std::string::npos || low.find("permi") != std::string::npos)) {
    text +=
        "; a udev rule lets users open it: SUBSYSTEM==\"usb\", ATTRS{idVendor}==\"VVVV\", "
        "MODE=\"0660\", GROUP=\"plugdev\"";
  } else if (low.find("busy") != std::string::npos) {
    throwBusy();
  }
  throw CameraError(text);
}

void AravisConnection::onControlLost(ArvDevice* /*device*/, gpointer lost) {
  **static_cast<std::shared_ptr<std::atomic<bool>>*>(lost) = true;
}

void AravisConnection::requireAlive() const {
  if (*lost_) throw CameraError(describe(device_) + " no longer answers");
}

bool AravisConnection::has(const char* feature) const {
  Failure failure;
  return arv_camera_is_feature_available(camera(), feature, failure.out()) && !failure;
}

void AravisConnection::refuseIf(const Failure& failure, const std::string& what) const {
  if (!failure) return;
  if (failure.is(ARV_DEVICE_ERROR_PROTOCOL_ERROR_ACCESS_DENIED) ||
      failure.is(ARV_DEVICE_ERROR_NOT_CONTROLLER)) {
    throwBusy();
  }
  throw CameraError(describe(device_) + ": " + what + ": " + failure.text());
}

bool AravisConnection::tellIf(const Failure& failure, const std::string& what) {
  if (!failure) return false;
  if (failure.is(ARV_DEVICE_ERROR_TIMEOUT) || failure.is(ARV_DEVICE_ERROR_NOT_CONNECTED)) {
    throw CameraError(describe(device_) + " no longer answers");
  }
  remark(what + ": " + failure.text());
  return true;
}

}  // namespace omnister::device
