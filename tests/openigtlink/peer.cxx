// A peer made of the reference C++ library (Debian: libopenigtlink-dev).
//
//   peer golden FOLDER              writes one message of each kind, as the library packs it
//   peer receive HOST PORT COUNT    connects, reads COUNT messages, checks each CRC, prints a line of JSON each
//   peer send HOST PORT FILE...     connects, sends the files' bytes, then prints what comes back until the end
//   peer ask HOST PORT TYPE         sends an empty TYPE (GET_STATUS ...) and prints the first answer that is no stream
//   peer serve PORT FILE...         waits for one client, sends it the files' bytes, prints what it sends
//   peer follow HOST PORT KIND N    sends STT_TDATA or STT_QTDATA (20 ms), prints N answers, sends STP_, prints what follows
//                                   up to the answer to STP_
//   peer move HOST PORT COUNT NAME N...  sends TRANSFORM NAME with 12 numbers, row by row, then prints COUNT messages
//
// g++ peer.cxx -I/usr/include/openigtlink -lOpenIGTLink -lpthread -o peer

#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

#include "igtlCapabilityMessage.h"
#include "igtlClientSocket.h"
#include "igtlImageMessage.h"
#include "igtlMessageHeader.h"
#include "igtlNDArrayMessage.h"
#include "igtlPointMessage.h"
#include "igtlPolyDataMessage.h"
#include "igtlPositionMessage.h"
#include "igtlServerSocket.h"
#include "igtlStatusMessage.h"
#include "igtlQuaternionTrackingDataMessage.h"
#include "igtlStringMessage.h"
#include "igtlTrackingDataMessage.h"
#include "igtlTransformMessage.h"

static void write(const std::string &folder, const std::string &name, igtl::MessageBase *m) {
  m->SetDeviceName(name.c_str());
  m->SetTimeStamp(1700000000u, 0x80000000u);  // half a second past
  m->Pack();
  std::ofstream(folder + "/" + name + ".bin", std::ios::binary)
      .write(static_cast<char *>(m->GetPackPointer()), m->GetPackSize());
}

static int golden(const std::string &folder) {
  igtl::Matrix4x4 matrix = {{0, 0, 1, 10.5f}, {1, 0, 0, -20.25f}, {0, 1, 0, 30.125f}, {0, 0, 0, 1}};
  igtl::TransformMessage::Pointer transform = igtl::TransformMessage::New();
  transform->SetMatrix(matrix);
  write(folder, "NeedleToReference", transform);

  // 5 columns, 3 rows, 2 slices; spacing 0.2, 0.3, 2 mm; the axes are not those of space
  igtl::ImageMessage::Pointer image = igtl::ImageMessage::New();
  image->SetDimensions(5, 3, 2);
  image->SetSpacing(0.2f, 0.3f, 2.0f);
  image->SetScalarTypeToInt16();
  image->SetEndian(igtl::ImageMessage::ENDIAN_BIG);
  image->SetSubVolume(5, 3, 2, 0, 0, 0);
  image->SetMatrix(matrix);
  image->SetCoordinateSystem(1);
  image->AllocateScalars();
  unsigned char *voxel = static_cast<unsigned char *>(image->GetScalarPointer());
  for (int i = 0; i < 30; ++i) {  // big-endian 300, 301, ...
    voxel[2 * i] = (300 + i) >> 8;
    voxel[2 * i + 1] = (300 + i) & 255;
  }
  write(folder, "ImageRasBig", image);
  image->SetCoordinateSystem(2);
  image->SetEndian(igtl::ImageMessage::ENDIAN_LITTLE);
  for (int i = 0; i < 30; ++i) {
    voxel[2 * i] = (300 + i) & 255;
    voxel[2 * i + 1] = (300 + i) >> 8;
  }
  write(folder, "ImageLpsLittle", image);

  igtl::StatusMessage::Pointer status = igtl::StatusMessage::New();
  status->SetCode(igtl::StatusMessage::STATUS_NOT_READY);
  status->SetSubCode(-77);
  status->SetErrorName("warming up");
  status->SetStatusString("ten seconds more");
  write(folder, "Status", status);

  igtl::StringMessage::Pointer string = igtl::StringMessage::New();
  string->SetString("start the needle");
  write(folder, "String", string);

  igtl::CapabilityMessage::Pointer capability = igtl::CapabilityMessage::New();
  std::vector<std::string> types;
  types.push_back("IMAGE");
  types.push_back("GET_STATUS");
  types.push_back("TRANSFORM");
  capability->SetTypes(types);
  write(folder, "Capability", capability);

  igtl::PointMessage::Pointer point = igtl::PointMessage::New();
  igtl::PointElement::Pointer target = igtl::PointElement::New(), entry = igtl::PointElement::New();
  target->SetName("Target");
  target->SetGroupName("Landmark");
  target->SetRGBA(1, 2, 3, 4);
  target->SetPosition(1.25f, 2.5f, -3.75f);
  target->SetRadius(0.5f);
  target->SetOwner("Image");
  entry->SetName("Entry");
  entry->SetGroupName("Landmark");
  entry->SetRGBA(255, 0, 0, 255);
  entry->SetPosition(0, 0, 0);
  entry->SetRadius(0);
  entry->SetOwner("");
  point->AddPointElement(target);
  point->AddPointElement(entry);
  write(folder, "Point", point);

  igtl::PolyDataMessage::Pointer mesh = igtl::PolyDataMessage::New();
  igtl::PolyDataPointArray::Pointer points = igtl::PolyDataPointArray::New();
  for (int i = 0; i < 4; ++i) points->AddPoint(i % 2, i / 2, 0.5f * i);
  mesh->SetPoints(points);
  igtl::PolyDataCellArray::Pointer quads = igtl::PolyDataCellArray::New(), lines = igtl::PolyDataCellArray::New();
  igtlUint32 quad[4] = {0, 1, 3, 2}, line[3] = {0, 1, 2};
  quads->AddCell(4, quad);
  lines->AddCell(3, line);
  lines->AddCell(2, line + 1);
  mesh->SetPolygons(quads);
  mesh->SetLines(lines);
  mesh->ClearAttributes();
  igtl::PolyDataAttribute::Pointer displacement = igtl::PolyDataAttribute::New(), strain = igtl::PolyDataAttribute::New();
  displacement->SetType(igtl::PolyDataAttribute::POINT_VECTOR);
  displacement->SetName("displacement");
  displacement->SetSize(4);
  igtlFloat32 vectors[12] = {0, 0.5f, 1, 1.5f, 2, 2.5f, 3, 3.5f, 4, 4.5f, 5, 5.5f};
  displacement->SetData(vectors);
  strain->SetType(igtl::PolyDataAttribute::POINT_SCALAR);
  strain->SetName("strain");
  strain->SetSize(4);
  igtlFloat32 scalars[4] = {-1, 0, 1, 2};
  strain->SetData(scalars);
  mesh->AddAttribute(displacement);
  mesh->AddAttribute(strain);
  write(folder, "PolyData", mesh);

  mesh->ClearAttributes();  // with names of an odd length, which the protocol pads
  mesh->AddAttribute(strain);
  write(folder, "PolyDataOdd", mesh);

  igtl::NDArrayMessage::Pointer array = igtl::NDArrayMessage::New();
  igtl::Array<igtlFloat64> numbers;
  std::vector<igtlUint16> size;
  size.push_back(2);
  size.push_back(3);
  numbers.SetSize(size);
  igtlFloat64 values[6] = {0, 0.125, 0.25, 0.375, 0.5, -1e300};
  numbers.SetArray(values);
  array->SetArray(igtl::NDArrayMessage::TYPE_FLOAT64, &numbers);
  write(folder, "NDArray", array);

  igtl::TrackingDataMessage::Pointer tools = igtl::TrackingDataMessage::New();
  igtl::TrackingDataElement::Pointer needle = igtl::TrackingDataElement::New(), probe = igtl::TrackingDataElement::New();
  needle->SetName("NeedleTipToReference");
  needle->SetType(igtl::TrackingDataElement::TYPE_6D);
  needle->SetMatrix(matrix);
  probe->SetName("Probe");
  probe->SetType(igtl::TrackingDataElement::TYPE_5D);
  igtl::Matrix4x4 other = {{1, 0, 0, 100}, {0, 0, -1, 200}, {0, 1, 0, -300}, {0, 0, 0, 1}};
  probe->SetMatrix(other);
  tools->AddTrackingDataElement(needle);
  tools->AddTrackingDataElement(probe);
  write(folder, "TrackingData", tools);

  igtl::QuaternionTrackingDataMessage::Pointer turned = igtl::QuaternionTrackingDataMessage::New();
  igtl::QuaternionTrackingDataElement::Pointer stylus = igtl::QuaternionTrackingDataElement::New();
  stylus->SetName("StylusToTracker");
  stylus->SetType(igtl::QuaternionTrackingDataElement::TYPE_6D);
  stylus->SetPosition(1.5f, -2.5f, 300.5f);
  stylus->SetQuaternion(0.5f, -0.5f, 0.5f, 0.5f);
  turned->AddQuaternionTrackingDataElement(stylus);
  write(folder, "QuaternionData", turned);

  igtl::StartTrackingDataMessage::Pointer start = igtl::StartTrackingDataMessage::New();
  start->SetResolution(50);
  start->SetCoordinateName("Tracker");
  write(folder, "StartTracking", start);
  igtl::StopTrackingDataMessage::Pointer stop = igtl::StopTrackingDataMessage::New();
  write(folder, "StopTracking", stop);
  igtl::RTSTrackingDataMessage::Pointer started = igtl::RTSTrackingDataMessage::New();
  started->SetStatus(igtl::RTSTrackingDataMessage::STATUS_SUCCESS);
  write(folder, "StartedTracking", started);

  igtl::GetStatusMessage::Pointer question = igtl::GetStatusMessage::New();
  write(folder, "GetStatus", question);
  igtl::GetCapabilityMessage::Pointer abilities = igtl::GetCapabilityMessage::New();
  write(folder, "GetCapability", abilities);

  // last, because the library writes beyond the shorter ones
  const int lengths[3] = {igtl::PositionMessage::ALL, igtl::PositionMessage::WITH_QUATERNION3, igtl::PositionMessage::POSITION_ONLY};
  const char *names[3] = {"Position7", "Position6", "Position3"};
  for (int i = 0; i < 3; ++i) {
    igtl::PositionMessage::Pointer position = igtl::PositionMessage::New();
    position->SetPackType(lengths[i]);
    position->SetPosition(1.5f, -2.5f, 3.5f);
    position->SetQuaternion(0.5f, -0.5f, 0.5f, 0.5f);
    write(folder, names[i], position);
  }
  return 0;
}

template <class Kind> static typename Kind::Pointer body(igtl::Socket *socket, igtl::MessageHeader *header, int &ok) {
  typename Kind::Pointer m = Kind::New();
  m->SetMessageHeader(header);
  m->AllocatePack();
  if (m->GetPackBodySize() > 0) socket->Receive(m->GetPackBodyPointer(), m->GetPackBodySize());
  ok = (m->Unpack(1) & igtl::MessageHeader::UNPACK_BODY) != 0;  // 1: check the CRC
  return m;
}

static unsigned checksum(const unsigned char *data, long n) {  // Adler-32, as zlib has it
  unsigned a = 1, b = 0;
  for (long i = 0; i < n; ++i) {
    a = (a + data[i]) % 65521;
    b = (b + a) % 65521;
  }
  return (b << 16) | a;
}

static void print(const igtl::Matrix4x4 &m) {
  std::printf("[");
  for (int i = 0; i < 4; ++i)
    std::printf("[%.9g, %.9g, %.9g, %.9g]%s", m[i][0], m[i][1], m[i][2], m[i][3], i < 3 ? ", " : "]");
}

// one message as a line of JSON; false at the end of the stream
static bool receive(igtl::Socket *socket, std::string *kind = 0) {
  igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
  header->InitPack();
  if (socket->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) return false;
  header->Unpack();
  std::string type = header->GetDeviceType();
  unsigned seconds, fraction;
  header->GetTimeStamp(&seconds, &fraction);
  std::printf("{\"type\": \"%s\", \"device\": \"%s\", \"time\": %.6f, ", type.c_str(), header->GetDeviceName(),
              seconds + fraction / 4294967296.0);
  int ok = 0;
  if (type == "TRANSFORM") {
    igtl::TransformMessage::Pointer m = body<igtl::TransformMessage>(socket, header, ok);
    igtl::Matrix4x4 matrix;
    m->GetMatrix(matrix);
    std::printf("\"matrix\": ");
    print(matrix);
  } else if (type == "IMAGE") {
    igtl::ImageMessage::Pointer m = body<igtl::ImageMessage>(socket, header, ok);
    int size[3];
    float spacing[3];
    igtl::Matrix4x4 matrix;
    m->GetDimensions(size);
    m->GetSpacing(spacing);
    m->GetMatrix(matrix);
    std::printf("\"size\": [%d, %d, %d], \"spacing\": [%.9g, %.9g, %.9g], \"scalar\": %d, \"components\": %d, "
                "\"space\": %d, \"adler\": %u, \"matrix\": ", size[0], size[1], size[2], spacing[0], spacing[1], spacing[2],
                m->GetScalarType(), m->GetNumComponents(), m->GetCoordinateSystem(),
                checksum(static_cast<unsigned char *>(m->GetScalarPointer()), m->GetImageSize()));
    print(matrix);
  } else if (type == "POSITION") {
    igtl::PositionMessage::Pointer m = body<igtl::PositionMessage>(socket, header, ok);
    float p[3], q[4];
    m->GetPosition(p);
    m->GetQuaternion(q);
    std::printf("\"position\": [%.9g, %.9g, %.9g], \"quaternion\": [%.9g, %.9g, %.9g, %.9g]", p[0], p[1], p[2], q[0],
                q[1], q[2], q[3]);
  } else if (type == "STATUS") {
    igtl::StatusMessage::Pointer m = body<igtl::StatusMessage>(socket, header, ok);
    std::printf("\"code\": %d, \"subcode\": %lld, \"error\": \"%s\", \"text\": \"%s\"", m->GetCode(),
                static_cast<long long>(m->GetSubCode()), m->GetErrorName(), m->GetStatusString());
  } else if (type == "STRING") {
    igtl::StringMessage::Pointer m = body<igtl::StringMessage>(socket, header, ok);
    std::printf("\"encoding\": %d, \"bytes\": %d", m->GetEncoding(), static_cast<int>(std::strlen(m->GetString())));
  } else if (type == "CAPABILITY") {
    igtl::CapabilityMessage::Pointer m = body<igtl::CapabilityMessage>(socket, header, ok);
    std::printf("\"types\": [");
    for (int i = 0; i < m->GetNumberOfTypes(); ++i) std::printf("%s\"%s\"", i ? ", " : "", m->GetType(i));
    std::printf("]");
  } else if (type == "POINT") {
    igtl::PointMessage::Pointer m = body<igtl::PointMessage>(socket, header, ok);
    std::printf("\"points\": [");
    for (int i = 0; i < m->GetNumberOfPointElement(); ++i) {
      igtl::PointElement::Pointer p;
      float x, y, z;
      m->GetPointElement(i, p);
      p->GetPosition(x, y, z);
      std::printf("%s{\"name\": \"%s\", \"group\": \"%s\", \"position\": [%.9g, %.9g, %.9g], \"radius\": %.9g}",
                  i ? ", " : "", p->GetName(), p->GetGroupName(), x, y, z, p->GetRadius());
    }
    std::printf("]");
  } else if (type == "POLYDATA") {
    igtl::PolyDataMessage::Pointer m = body<igtl::PolyDataMessage>(socket, header, ok);
    int n = ok ? m->GetPoints()->GetNumberOfPoints() : 0;
    std::printf("\"polygons\": %d, \"points\": [", ok ? static_cast<int>(m->GetPolygons()->GetNumberOfCells()) : 0);
    for (int i = 0; i < n; ++i) {
      float x, y, z;
      m->GetPoints()->GetPoint(i, x, y, z);
      std::printf("%s[%.9g, %.9g, %.9g]", i ? ", " : "", x, y, z);
    }
    std::printf("], \"attributes\": [");
    for (int i = 0; ok && i < m->GetNumberOfAttributes(); ++i)
      std::printf("%s\"%s\"", i ? ", " : "", m->GetAttribute(i)->GetName());
    std::printf("]");
  } else if (type == "TDATA") {
    igtl::TrackingDataMessage::Pointer m = body<igtl::TrackingDataMessage>(socket, header, ok);
    std::printf("\"tools\": [");
    for (int i = 0; ok && i < m->GetNumberOfTrackingDataElements(); ++i) {
      igtl::TrackingDataElement::Pointer tool;
      igtl::Matrix4x4 matrix;
      m->GetTrackingDataElement(i, tool);
      tool->GetMatrix(matrix);
      std::printf("%s{\"name\": \"%s\", \"kind\": %d, \"matrix\": ", i ? ", " : "", tool->GetName(), tool->GetType());
      print(matrix);
      std::printf("}");
    }
    std::printf("]");
  } else if (type == "QTDATA") {
    igtl::QuaternionTrackingDataMessage::Pointer m = body<igtl::QuaternionTrackingDataMessage>(socket, header, ok);
    std::printf("\"tools\": [");
    for (int i = 0; ok && i < m->GetNumberOfQuaternionTrackingDataElements(); ++i) {
      igtl::QuaternionTrackingDataElement::Pointer tool;
      float p[3], q[4];
      m->GetQuaternionTrackingDataElement(i, tool);
      tool->GetPosition(p);
      tool->GetQuaternion(q);
      std::printf("%s{\"name\": \"%s\", \"kind\": %d, \"position\": [%.9g, %.9g, %.9g], "
                  "\"quaternion\": [%.9g, %.9g, %.9g, %.9g]}", i ? ", " : "", tool->GetName(), tool->GetType(), p[0],
                  p[1], p[2], q[0], q[1], q[2], q[3]);
    }
    std::printf("]");
  } else if (type == "RTS_TDATA") {
    igtl::RTSTrackingDataMessage::Pointer m = body<igtl::RTSTrackingDataMessage>(socket, header, ok);
    std::printf("\"status\": %d", m->GetStatus());
  } else if (type == "RTS_QTDATA") {
    igtl::RTSQuaternionTrackingDataMessage::Pointer m = body<igtl::RTSQuaternionTrackingDataMessage>(socket, header, ok);
    std::printf("\"status\": %d", m->GetStatus());
  } else if (type == "NDARRAY") {
    igtl::NDArrayMessage::Pointer m = body<igtl::NDArrayMessage>(socket, header, ok);
    std::printf("\"scalar\": %d, \"axes\": %d", m->GetType(), m->GetArray()->GetDimension());
  } else {
    socket->Skip(header->GetBodySizeToRead(), 0);
    std::printf("\"skipped\": %d", header->GetBodySizeToRead());
  }
  std::printf(", \"crc\": %s}\n", ok ? "true" : "false");
  std::fflush(stdout);
  if (kind) *kind = type;
  return true;
}

static void send(igtl::Socket *socket, int argc, char **argv, int first) {
  for (int i = first; i < argc; ++i) {
    std::ifstream file(argv[i], std::ios::binary);
    std::string bytes((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    socket->Send(bytes.data(), bytes.size());
  }
}

int main(int argc, char **argv) {
  std::string mode = argc > 2 ? argv[1] : "";
  if (mode == "golden") return golden(argv[2]);
  if (mode == "serve") {
    igtl::ServerSocket::Pointer server = igtl::ServerSocket::New();
    if (server->CreateServer(std::atoi(argv[2])) < 0) return 3;
    igtl::ClientSocket::Pointer client = server->WaitForConnection(20000);
    if (client.IsNull()) return 4;
    send(client, argc, argv, 3);
    while (receive(client)) {}
    return 0;
  }
  if (argc < 4) return 2;
  igtl::ClientSocket::Pointer socket = igtl::ClientSocket::New();
  if (socket->ConnectToServer(argv[2], std::atoi(argv[3])) != 0) return 3;
  if (mode == "receive") {
    for (int i = 0; i < std::atoi(argv[4]) && receive(socket); ++i) {}
  } else if (mode == "send") {
    send(socket, argc, argv, 4);
    while (receive(socket)) {}
  } else if (mode == "follow") {
    std::string type = argv[4], kind;
    igtl::MessageBase::Pointer start, stop;
    if (type == "TDATA") {
      igtl::StartTrackingDataMessage::Pointer m = igtl::StartTrackingDataMessage::New();
      m->SetResolution(20);
      start = m;
      stop = igtl::StopTrackingDataMessage::New();
    } else {
      igtl::StartQuaternionTrackingDataMessage::Pointer m = igtl::StartQuaternionTrackingDataMessage::New();
      m->SetResolution(20);
      start = m;
      stop = igtl::StopQuaternionTrackingDataMessage::New();
    }
    start->SetDeviceName("peer");
    start->Pack();
    socket->Send(start->GetPackPointer(), start->GetPackSize());
    for (int i = 0; i < std::atoi(argv[5]) && receive(socket, &kind);) i += kind == type;
    stop->SetDeviceName("peer");
    stop->Pack();
    socket->Send(stop->GetPackPointer(), stop->GetPackSize());
    while (receive(socket, &kind) && kind != "RTS_" + type) {}
  } else if (mode == "move") {
    if (argc < 18) return 2;
    igtl::Matrix4x4 matrix = {{0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 0}, {0, 0, 0, 1}};
    for (int i = 0; i < 12; ++i) matrix[i / 4][i % 4] = static_cast<float>(std::atof(argv[6 + i]));
    igtl::TransformMessage::Pointer m = igtl::TransformMessage::New();
    m->SetDeviceName(argv[5]);
    m->SetMatrix(matrix);
    m->Pack();
    socket->Send(m->GetPackPointer(), m->GetPackSize());
    for (int i = 0; i < std::atoi(argv[4]) && receive(socket); ++i) {}
  } else if (mode == "ask") {
    igtl::MessageBase::Pointer question;
    std::string type = argv[4];
    if (type == "GET_STATUS") question = igtl::GetStatusMessage::New();
    else question = igtl::GetCapabilityMessage::New();
    question->SetDeviceName("echospline");
    question->Pack();
    socket->Send(question->GetPackPointer(), question->GetPackSize());
    std::string kind;
    while (receive(socket, &kind) && kind != type.substr(4)) {}
  }
  socket->CloseSocket();
  return 0;
}
